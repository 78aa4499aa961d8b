#!/usr/bin/env bash
# Installs what complexbody needs: Debian packages, then Python packages into .venv.
# Run it as often as you like: what is there already is left alone.
set -euo pipefail
cd "$(dirname "$0")/.."

say() { echo "setup: $*"; }
die() { echo "setup: $*" >&2; exit 1; }
log_and_die() { tail -n 20 "$2" >&2; die "$1 failed; all it said is in $2"; }

packages=(python3-dolfinx python3-slepc4py python3-venv python3-dev python3-h5py python3-scipy
          python3-gmsh gcc openmpi-bin)
# Without a GL library VTK crashes instead of drawing.
. /etc/os-release
case "${ID:-}-${VERSION_ID:-none}" in
    debian-12) packages+=(libosmesa6) ;;
    debian-13) packages+=(libegl1 libgl1-mesa-dri) ;;
    debian-*)  packages+=(libegl1 libgl1-mesa-dri)
               say "${PRETTY_NAME:-this Debian} is untested; Debian 12 and 13 are supported" ;;
    *) die "this is ${PRETTY_NAME:-not Debian}; complexbody is installed on Debian 12 or 13." ;;
esac

# One set-up at a time: editors, terminals and CI may share a work tree.
mkdir -p build
exec 9>build/setup.lock
flock 9

# --- Debian packages
installed=$(dpkg-query -W -f '${db:Status-Status} ${Package}\n' "${packages[@]}" 2>/dev/null || true)
missing=()
for package in "${packages[@]}"; do
    grep -qx "installed $package" <<<"$installed" || missing+=("$package")
done
if ((${#missing[@]})); then
    as_root=()
    if ((EUID)); then
        command -v sudo >/dev/null || die "Debian packages are missing. As root, run:
    apt-get update && apt-get install --no-install-recommends ${missing[*]}"
        as_root=(sudo)
    fi
    say "installing Debian packages: ${missing[*]}"
    {
        "${as_root[@]}" apt-get -o Acquire::Retries=3 update &&
        "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get -y -o Acquire::Retries=3 \
            -o Dpkg::Use-Pty=0 install --no-install-recommends "${missing[@]}"
    } >build/setup-apt.log 2>&1 || log_and_die apt-get build/setup-apt.log
fi

# --- the virtual environment
# It breaks when it is moved or when apt's Python or numpy change: then it is made anew.
base=$(pwd; dpkg-query -W -f '${Version}\n' python3 python3-numpy)
# An editable install notes which folders are packages, hence the list of them.
packed=$(find complexbody forms -name __init__.py | sort)
stamp=$({ echo "$base" "$packed"; cat pyproject.toml tools/setup.sh; } | sha256sum)
if [[ -x .venv/bin/python && $(cat .venv/complexbody.stamp 2>/dev/null) == "$stamp" ]]; then
    exit 0
fi
if [[ $(cat .venv/complexbody.base 2>/dev/null) != "$base" ]]; then
    say "making .venv on Debian's Python"
    # Debian's own: a python3 that comes first on PATH may lack dolfinx.
    /usr/bin/python3 -m venv --clear --system-site-packages .venv
    echo "$base" >.venv/complexbody.base
fi

# Whatever apt provides stays apt's: a newer numpy breaks dolfinx, another h5py clashes in HDF5.
# Debian's h5py has no metadata that pip finds; "<0" turns an attempt to install one into an error.
/usr/bin/python3 - >.venv/constraints.txt <<'PYTHON'
from importlib.metadata import PackageNotFoundError, version

for name in ("numpy", "scipy", "h5py", "mpi4py", "petsc4py", "slepc4py"):
    try:
        print(f"{name}=={version(name)}")
    except PackageNotFoundError:
        print(f"{name}<0")
PYTHON

say "installing Python packages into .venv (on a new machine about 250 MB)"
export PIP_DEFAULT_TIMEOUT=${PIP_DEFAULT_TIMEOUT:-60} PIP_RETRIES=${PIP_RETRIES:-5}
.venv/bin/python -m pip install --quiet --disable-pip-version-check --root-user-action=ignore \
    -c .venv/constraints.txt -e '.[test]' >build/setup-pip.log 2>&1 ||
    log_and_die pip build/setup-pip.log

# --- proof
.venv/bin/python - <<'PYTHON'
import dolfinx
import h5py
import numpy
import petsc4py
import pyvista

for module in (numpy, h5py, petsc4py):
    assert "/usr/lib/" in module.__file__, f"{module.__file__} is not Debian's"
versions = {m.__name__: m.__version__ for m in (dolfinx, petsc4py, numpy, pyvista)}
print("setup: done:", ", ".join(f"{name} {version}" for name, version in versions.items()))
PYTHON
echo "$stamp" >.venv/complexbody.stamp
