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
        ComplexBodyError: if the compiler fails, with its first messages.
    """
    path, version = compiler()
    flags = (optimisation, *FLAGS)
    key = "\n".join([source, *flags, version, platform.machine(), *sorted(cpu_flags())])
    digest = hashlib.sha256(key.encode()).hexdigest()[:24]
    folder = _writable(cache_folder())
    library = folder / f"kernel-{digest}.so"
    if not library.exists():
        _compile(path, source, optimisation, library)
    return ctypes.CDLL(str(library))


def _writable(folder: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if os.access(folder, os.W_OK):
            return folder
    except OSError:
        pass
    # A read-only home (a cluster's compute node, say) must not stop a run.
    fallback = Path(tempfile.gettempdir()) / f"complexbody-{os.getuid()}"
    fallback.mkdir(mode=0o700, parents=True, exist_ok=True)
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
