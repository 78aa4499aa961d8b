# SPDX-License-Identifier: LGPL-3.0-or-later
"""One checkpoint as a file: named arrays and a description, whole or refused.

A NumPy archive (``numpy.load`` opens it) that ends in the SHA-256 of all before. It appears under
its name when it is complete and on the disk; any change of a bit or of its length is found. For one
process; knows no scene.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from complexbody.errors import CheckpointError
from complexbody.files import settle

Array = npt.NDArray[Any]

#: Changes when older files can no longer be read.
FORMAT = 2
_ABOUT, _DIGEST = "about.json", 64
_NAME = re.compile(r"step-(\d+)\.npz")


def path_of(folder: Path, steps: int) -> Path:
    """The file of the state after so many steps."""
    return folder / f"step-{steps:012d}.npz"


def listed(folder: Path) -> list[Path]:
    """Checkpoints of a folder, the newest first."""
    found = [path for path in folder.glob("step-*.npz") if _NAME.fullmatch(path.name)]
    return sorted(found, key=steps_of, reverse=True)


def steps_of(path: Path) -> int:
    """Steps after which the state was, by the file's name."""
    match = _NAME.fullmatch(path.name)
    assert match is not None
    return int(match[1])


def write(path: Path, about: Mapping[str, Any], arrays: Iterator[tuple[str, Array]]) -> int:
    """Write a checkpoint, which is there as a whole or not at all; its size in bytes.

    Args:
        path: The file.
        about: What JSON can say of it.
        arrays: Names and arrays, each asked for when the one before is written.

    Raises:
        OSError: if the file system refuses; no part of it stays.
    """
    draft = path.with_name(path.name + ".part")
    try:
        with draft.open("w+b") as file:
            with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
                for name, array in arrays:
                    with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                        np.save(member, np.asarray(array), allow_pickle=False)
                text = json.dumps({"format": FORMAT, **about}, default=_plain)
                archive.writestr(_ABOUT, text)
                archive.comment = b"0" * _DIGEST
            size = file.seek(0, os.SEEK_END)
            digest = _digest(file, size - _DIGEST)
            file.seek(size - _DIGEST)
            file.write(digest.encode())
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
    except BaseException:
        draft.unlink(missing_ok=True)
        raise
    settle(path.parent)
    return size


def read(path: Path) -> tuple[dict[str, Any], Mapping[str, Array]]:
    """The description and the arrays of a checkpoint, which is whole.

    Raises:
        CheckpointError: if it is damaged, cannot be read, or is of another version.
    """
    try:
        with path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            whole = size > _DIGEST
            if whole:
                digest = _digest(file, size - _DIGEST)
                whole = file.read(_DIGEST) == digest.encode()
    except OSError as error:
        raise CheckpointError(f"{path} cannot be read ({error}). Use an older one.") from error
    if not whole:
        raise CheckpointError(f"{path} is damaged: its checksum is wrong. Use an older one.")
    try:
        with zipfile.ZipFile(path) as archive:
            about = json.loads(archive.read(_ABOUT))
        made, versions = about["format"], about.get("versions")
    except (zipfile.BadZipFile, OSError, KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{path} is no checkpoint ({error!r}). Use another one.") from error
    if made != FORMAT:
        known = isinstance(versions, dict)
        writer = versions.get("complexbody", "unknown") if known else "unknown"
        raise CheckpointError(
            f"{path} has format {made}, and this version reads {FORMAT}. Use the "
            f"version that wrote it ({writer})."
        )
    return about, Arrays(path)


class Arrays(Mapping[str, Array]):
    """The arrays of a checkpoint, read when they are asked for."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __getitem__(self, name: str) -> Array:
        with np.load(self._path, allow_pickle=False) as archive:
            return np.asarray(archive[name])

    def __iter__(self) -> Iterator[str]:
        with np.load(self._path, allow_pickle=False) as archive:
            return iter([name for name in archive.files if name != _ABOUT])

    def __len__(self) -> int:
        return sum(1 for _ in self)


def _digest(file: Any, count: int) -> str:
    """SHA-256 of the first ``count`` bytes; the file is then behind them."""
    made = hashlib.sha256()
    file.seek(0)
    while count > 0:
        block = file.read(min(count, 1 << 22))
        if not block:
            break
        made.update(block)
        count -= len(block)
    return made.hexdigest()


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else str(value)
