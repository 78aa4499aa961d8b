# SPDX-License-Identifier: LGPL-3.0-or-later
"""Compile generated C into a shared library, once per content, and load it.

The cache is keyed by source, flags, compiler and CPU, so that a folder shared between machines
never hands one CPU the other's instructions. A file appears under its name only when whole.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import mmap
import os
import platform
import shutil
import subprocess
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from complexbody.errors import ComplexBodyError, MissingPackage

#: Kernels are for speed; who compiles many for a few steps each, as tests do, may ask for less.
FULL = "-O3"
OPTIMISATION = os.environ.get("COMPLEXBODY_OPTIMISATION") or FULL
FLAGS = ("-march=native", "-std=gnu11", "-fno-math-errno", "-fno-trapping-math",
         "-ffp-contract=fast", "-fPIC", "-shared", "-Wall", "-Wno-psabi")  # fmt: skip


def cache_folder() -> Path:
    """Where compiled kernels live: $COMPLEXBODY_CACHE, else $XDG_CACHE_HOME/complexbody."""
    own = os.environ.get("COMPLEXBODY_CACHE")
    if own:
        return Path(own)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "complexbody"


@functools.cache
def cpu_flags() -> frozenset[str]:
    """Instruction-set flags of this CPU (empty where /proc/cpuinfo is not there)."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith(("flags", "Features")):
                return frozenset(line.split(":", 1)[1].split())
    except OSError:
        pass
    return frozenset()


@functools.cache
def lanes() -> int:
    """How many doubles one vector of this CPU holds: cells are worked on so many at a time."""
    return 8 if "avx512f" in cpu_flags() else 4


@functools.cache
def compiler() -> tuple[str, str]:
    """The C compiler and its version line.

    Raises:
        MissingPackage: if there is none.
    """
    name = os.environ.get("CC") or "gcc"
    path = shutil.which(name.split()[0])
    if path is None:
        raise MissingPackage(
            f"No C compiler '{name}' was found, and kernels are compiled for each scene. "
            "Install one: apt install gcc."
        )
    done = subprocess.run([path, "--version"], capture_output=True, text=True, check=False)
    return path, (done.stdout.splitlines() or ["unknown"])[0]


@functools.cache
def load(source: str, optimisation: str = OPTIMISATION) -> ctypes.CDLL:
    """Compile ``source`` if no library of the same content is cached, and load it.

    Args:
        source: C.
        optimisation: The compiler's option; ``FULL`` for what all scenes share.

    Safe when many processes ask at once: each compiles under a name of its own and renames.

    Raises:
        MissingPackage: if there is no C compiler.
        ComplexBodyError: if the compiler fails, with its first messages, or there is no space.
    """
    path, version = compiler()
    flags = (optimisation, *FLAGS)
    key = "\n".join([source, *flags, version, platform.machine(), *sorted(cpu_flags())])
    digest = hashlib.sha256(key.encode()).hexdigest()[:24]
    library = writable(cache_folder()) / f"kernel-{digest}.so"
    for _ in range(2):
        try:
            if not _is_whole(library):
                _compile(path, source, optimisation, library)
            return ctypes.CDLL(str(library))
        except OSError as error:  # no space, or gone since
            failure = error
            library.unlink(missing_ok=True)
    raise ComplexBodyError(
        f"The kernel {library} cannot be made or loaded: {failure}. Check that its folder has free "
        "space and may be written, or set COMPLEXBODY_CACHE to another one."
    ) from failure


def _is_whole(library: Path) -> bool:
    """Whether a cached library ends with the digest of what is before: not cut short, not changed.

    The loader would not notice: it maps the file, and the process dies of SIGBUS.
    """
    try:
        content = library.read_bytes()
    except FileNotFoundError:
        return False
    return hashlib.sha256(content[:-32]).digest() == content[-32:]


@functools.cache
def writable(folder: Path, name: str = "") -> Path:
    """The folder's part ``name``, made if it is missing; or one in the temporary folder.

    A read-only home (a cluster's compute node, say) must not stop a run: it is told, once.
    """
    for place in (folder / name, _temporary() / name):
        with contextlib.suppress(OSError):
            place.mkdir(parents=True, exist_ok=True)
            if os.access(place, os.W_OK):
                if place != folder / name:
                    warnings.warn(
                        f"The cache {folder / name} cannot be written, so {place} is used: "
                        "kernels are compiled anew on each machine. Set COMPLEXBODY_CACHE to a "
                        "folder that can.",
                        UserWarning, stacklevel=2,
                    )  # fmt: skip
                return place
    raise ComplexBodyError(
        f"Neither the cache {folder / name} nor the temporary folder can be written. Set "
        "COMPLEXBODY_CACHE to a folder that can."
    )


def _temporary() -> Path:
    """A folder of the user's own in the temporary one, closed to others.

    Raises:
        ComplexBodyError: if it is somebody else's, who could put code there.
    """
    fallback = Path(tempfile.gettempdir()) / f"complexbody-{os.getuid()}"
    with contextlib.suppress(OSError):
        fallback.mkdir(mode=0o700, parents=True, exist_ok=True)
    if fallback.exists() and fallback.stat().st_uid != os.getuid():
        raise ComplexBodyError(
            f"{fallback} is another user's. Set COMPLEXBODY_CACHE to a folder of your own."
        )
    return fallback


def _compile(path: str, source: str, optimisation: str, library: Path) -> None:
    with tempfile.TemporaryDirectory(dir=library.parent) as scratch:
        c_file, so_file = Path(scratch) / "kernel.c", Path(scratch) / "kernel.so"
        c_file.write_text(source)
        done = subprocess.run(
            [path, optimisation, *FLAGS, "-o", str(so_file), str(c_file), "-lm"],
            capture_output=True, text=True, check=False, env=dict(os.environ),
        )  # fmt: skip
        if done.returncode != 0:
            text = "\n".join(done.stderr.splitlines()[:8])
            raise ComplexBodyError(
                f"The C compiler {path} failed on a generated kernel. Check that it works and that "
                f"{library.parent} has free space; it said:\n{text}"
            )
        with so_file.open("r+b") as file:
            digest = hashlib.sha256(file.read()).digest()
            file.write(digest)
            file.flush()
            os.fsync(file.fileno())
        os.replace(so_file, library)


@functools.cache
def template(name: str) -> str:
    """Text of a C file of the kernels folder."""
    return (Path(__file__).parent / "kernels" / name).read_text()


def pointer(array: npt.NDArray[Any] | None) -> ctypes.c_void_p:
    """Address of a C-contiguous array's data (null for None)."""
    if array is None:
        return ctypes.c_void_p(None)
    assert array.flags.c_contiguous
    return ctypes.c_void_p(array.ctypes.data)


#: Arrays of at least this many bytes ask for huge pages: events jump from node to node.
HUGE = 1 << 21


def aligned(shape: tuple[int, ...], dtype: Any = np.float64) -> npt.NDArray[Any]:
    """Zeros whose first element lies on a 64-byte boundary, with one spare vector behind them."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    if size >= HUGE and hasattr(mmap, "MADV_HUGEPAGE"):
        return _huge(size).view(dtype).reshape(shape)
    buffer = np.zeros(size + 192, dtype=np.uint8)
    start = (-buffer.ctypes.data) % 64
    return buffer[start : start + size].view(dtype).reshape(shape)


def _huge(size: int) -> npt.NDArray[np.uint8]:
    """Zeroed bytes on pages of 2 MB, where the kernel has them to give."""
    pages = mmap.mmap(-1, size + 192 + HUGE, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    with contextlib.suppress(OSError):  # a kernel without them
        pages.madvise(mmap.MADV_HUGEPAGE)
    buffer = np.frombuffer(pages, dtype=np.uint8)
    start = (-buffer.ctypes.data) % HUGE
    return buffer[start : start + size]
