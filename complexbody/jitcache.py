# SPDX-License-Identifier: LGPL-3.0-or-later
"""FFCx's cache of compiled forms, made safe: killed compiles, concurrent first runs, other CPUs.

FFCx marks a compile under way by a C file and its end by a second file; a killed one leaves the
first, for which every later run waits and then gives up. Here one process at a time compiles into
the folder, under a lock that dies with it: whatever is half done when the lock is had was left
behind, and is removed. The folder is keyed by CPU, since forms are compiled for the one at hand.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

from complexbody import native
from complexbody.errors import ComplexBodyError

#: Seconds to wait for another process that compiles, before going on without the lock.
PATIENCE = 600.0
#: Seconds after which what dolfinx itself compiles (elements, outside any lock) was left behind.
OLD = 30.0

T = TypeVar("T")


def folder() -> Path:
    """Where compiled forms live, for this CPU."""
    key = hashlib.sha256(" ".join(sorted(native.cpu_flags())).encode()).hexdigest()[:12]
    return native.writable(native.cache_folder(), f"ffcx-{key}")


@contextmanager
def locked(place: Path) -> Iterator[bool]:
    """Hold the folder's lock; yields False where there is none to be had (some file systems)."""
    try:
        file = (place / "lock").open("w")
    except OSError:
        yield False
        return
    with file:
        deadline, held = time.monotonic() + PATIENCE, False
        while not held and time.monotonic() < deadline:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                held = True
            except BlockingIOError:
                time.sleep(0.02)
            except OSError:
                break
        yield held


def heal(place: Path, age: float = 0.0) -> list[str]:
    """Remove modules that are half made, and libraries cut short; names of those removed.

    Args:
        place: The cache.
        age: Seconds since its last change for a half made one to count as left behind.
    """
    removed, names = [], os.listdir(place)  # once: caches hold thousands of files
    ready = {name[: -len(".c.cached")] for name in names if name.endswith(".c.cached")}
    libraries: dict[str, list[str]] = {}
    for name in names:
        if name.startswith("libffcx_") and name.endswith("so"):
            libraries.setdefault(name.partition(".")[0], []).append(f"{place}/{name}")
    for name in names:
        stem = name.removesuffix(".c")
        if stem == name or not name.startswith("libffcx_"):
            continue
        with suppress(FileNotFoundError):
            found = libraries.get(stem, [])
            if stem in ready and found and all(_sound(library) for library in found):
                continue
            if stem not in ready and time.time() - (place / name).stat().st_mtime < age:
                continue
            removed.append(stem)
            remove(place, stem)
    return removed


#: Libraries that this process has found whole, and what they were then: size and time.
_known: dict[str, tuple[int, int]] = {}


def _sound(library: str) -> bool:
    """Whether a library is whole; looks into it once, and again after a change."""
    status = os.stat(library)
    state = status.st_size, status.st_mtime_ns
    if _known.get(library) != state:
        if not whole(Path(library)):
            return False
        _known[library] = state
    return True


def remove(place: Path, name: str) -> None:
    """Remove all files of a module, the one that others wait for at last."""
    for path in sorted(place.glob(f"{name}.*"), key=lambda p: p.suffix == ".c"):
        path.unlink(missing_ok=True)


def whole(library: Path) -> bool:
    """Whether an ELF file is as long as its header says: the section table lies at its end."""
    with library.open("rb") as file:
        head = file.read(64)
    if len(head) < 64 or head[:5] != b"\x7fELF\x02":
        return False
    offset = struct.unpack_from("<Q", head, 40)[0]
    size, count = struct.unpack_from("<HH", head, 58)
    return bool(library.stat().st_size >= offset + size * count)


def wait_and_heal(place: Path) -> None:
    """Heal a folder that others compile into without a lock: what does not end soon is removed."""
    if not place.is_dir():
        return
    deadline = time.monotonic() + OLD + 1.0
    while time.monotonic() < deadline:
        with suppress(OSError):
            heal(place, OLD)
        if all(c.with_suffix(".c.cached").exists() for c in place.glob("libffcx_*.c")):
            return
        time.sleep(0.25)


def compiled(comm: Any, make: Callable[[str], T]) -> T:
    """What ``make`` compiles into the cache whose path it is given; collective.

    Args:
        comm: Of those that call it; rank 0 compiles, the others load.
        make: Calls dolfinx; collective.

    Raises:
        ComplexBodyError: if it fails twice, the second time in a healed cache.
    """
    place = folder()
    for attempt in range(2):
        try:
            if comm.rank > 0:
                return make(str(place))
            with locked(place) as held:
                if held:
                    heal(place)
                return make(str(place))
        except (TimeoutError, ImportError, OSError, RuntimeError) as error:
            if attempt:
                raise ComplexBodyError(
                    f"A form cannot be compiled: {type(error).__name__}: {error}. Check that "
                    f"{place} has free space, and remove it."
                ) from error
            if comm.rank == 0:
                # A library that does not load is in nobody's way but its own.
                for path in place.glob("libffcx_*.c"):
                    if path.stem in str(error):
                        remove(place, path.stem)
    raise AssertionError
