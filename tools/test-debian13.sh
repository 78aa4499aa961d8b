#!/usr/bin/env bash
# Runs `make test`, or the command given as arguments, in a Debian 13 root made for it (once, about
# 4 GB). Needs root on any Debian. The work tree is copied in; nothing comes back but the output.
set -euo pipefail
cd "$(dirname "$0")/.."

say() { echo "debian13: $*"; }
die() { echo "debian13: $*" >&2; exit 1; }

command=${*:-make test}
root=${COMPLEXBODY_DEBIAN13:-${XDG_CACHE_HOME:-$HOME/.cache}/complexbody/debian13-root}
((EUID == 0)) || die "making a root file system needs root: sudo -E tools/test-debian13.sh"

if [[ ! -e $root/complete ]]; then
    command -v mmdebstrap >/dev/null || {
        say "installing mmdebstrap"
        apt-get -qq update
        DEBIAN_FRONTEND=noninteractive apt-get -qq -y install --no-install-recommends \
            mmdebstrap debian-archive-keyring
    }
    # The mirrors, proxies and checks that this machine's apt is set to, for another release.
    here=$(. /etc/os-release; echo "$VERSION_CODENAME")
    sources=$(apt-get indextargets --format '$(RELEASE) $(REPO_URI) $(COMPONENT)' 'Created-By: Packages' |
        sed -nE "s#^$here(-updates|-security)? ([^ ]+) main\$#deb \2 trixie\1 main#p" | sort -u)
    [[ $sources ]] || die "apt's configuration names no mirror of $here"
    mkdir -p "$root" build
    apt-config dump | grep -E '^Acquire::(https?|Check-)' >build/apt-options || true
    say "making $root"
    # What a cut-short attempt left; no mount lives there beyond the namespace below.
    rm -rf --one-file-system "${root:?}"
    mmdebstrap --quiet --mode=root --variant=minbase --include=make,ca-certificates \
        --aptopt="$PWD/build/apt-options" trixie "$root" - <<<"$sources"
    touch "$root/complete"
fi

# The tree as git sees it, without what is ignored; the root keeps its own .venv and caches.
mkdir -p "$root/complexbody"
find "$root/complexbody" -mindepth 1 -maxdepth 1 ! -name .venv -exec rm -rf --one-file-system {} +
git ls-files -coz --exclude-standard | while IFS= read -r -d '' file; do
    [[ -e $file ]] && printf '%s\0' "$file"
done | tar -c --null -T - | tar -xC "$root/complexbody"

# pip's settings, and below the local files and directories that they name (certificates, indices).
for file in /etc/pip.conf "$HOME/.pip/pip.conf" "${XDG_CONFIG_HOME:-$HOME/.config}/pip/pip.conf"; do
    case $file in /etc/*) to=$root/etc/pip.conf ;; *) to=$root/root/.config/pip/pip.conf ;; esac
    if [[ -r $file ]]; then install -Dm600 "$file" "$to"; fi
done
named=$({ cat "$root/etc/pip.conf" "$root/root/.config/pip/pip.conf" 2>/dev/null; env | grep ^PIP_; } |
    grep -oE '(file://|^|[= ])/[^ ,;]+' | sed -E 's#^(file://|[= ])##; s#/simple/?$##' | sort -u || true)
cp /etc/resolv.conf "$root/etc/resolv.conf"

# Mounts live in a namespace of their own and die with it, as do the processes.
export root named command
exec unshare --mount --pid --fork --kill-child --propagation private bash -euc '
    mount -t proc proc "$root/proc"
    mount -t sysfs -o ro sysfs "$root/sys"
    mkdir -p "$root/dev/shm"
    mount -t tmpfs tmpfs "$root/dev/shm"
    for path in $named; do
        [[ -e $path ]] || continue
        if [[ -d $path ]]; then mkdir -p "$root$path"; else mkdir -p "$root${path%/*}"; touch "$root$path"; fi
        mount --bind -o ro "$path" "$root$path"
    done
    mapfile -t settings < <(env | grep -E "^(PIP_|CI=|https?_proxy=|no_proxy=)")
    exec chroot "$root" env -i "${settings[@]}" HOME=/root LANG=C.UTF-8 TERM="${TERM:-dumb}" \
        PATH=/usr/local/bin:/usr/bin:/bin:/usr/sbin:/sbin \
        bash -c "cd /complexbody && $command"'
