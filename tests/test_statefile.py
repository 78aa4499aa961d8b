# SPDX-License-Identifier: LGPL-3.0-or-later
"""A checkpoint's file is whole or refused; whoever looks into it needs NumPy alone."""

import json
import os
import resource

import numpy as np
import pytest

from complexbody import statefile
from complexbody.errors import CheckpointError

pytestmark = pytest.mark.serial

ABOUT = {"time": 0.1 + 0.2, "limit": float("inf"), "name": "ν", "flag": True, "list": [1, 2]}
ARRAYS = {
    "nodes/x": np.linspace(0, 1, 60).reshape(20, 3), "cells/counter": np.arange(7),
    "ledger": np.zeros((0, 4)),
}  # fmt: skip


def made(folder, steps=5):
    path = statefile.path_of(folder, steps)
    size = statefile.write(path, ABOUT, iter(ARRAYS.items()))
    assert size == path.stat().st_size
    return path


def test_what_is_written_is_read(tmp_path):
    path = made(tmp_path)
    about, arrays = statefile.read(path)
    assert about == {"format": statefile.FORMAT, **ABOUT}
    assert set(arrays) == set(ARRAYS) and len(arrays) == len(ARRAYS)
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(arrays[name], array)
        assert arrays[name].dtype == array.dtype
    with np.load(path) as archive:
        np.testing.assert_array_equal(archive["nodes/x"], ARRAYS["nodes/x"])
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    made(tmp_path, 12)
    assert [statefile.steps_of(p) for p in statefile.listed(tmp_path)] == [12, 5]


def test_every_damage_is_found(tmp_path):
    """Forty bits turned, forty truncations, bytes added: none is taken for a checkpoint."""
    path, rng = made(tmp_path), np.random.default_rng(3)
    whole = path.read_bytes()
    for _ in range(40):
        bad = bytearray(whole)
        bad[rng.integers(len(whole))] ^= 1 << rng.integers(8)
        for content in (bytes(bad), whole[: rng.integers(len(whole))]):
            path.write_bytes(content)
            with pytest.raises(CheckpointError, match="is damaged"):
                statefile.read(path)
    for content in (b"", whole + b"0", whole[1:], bytes(len(whole))):
        path.write_bytes(content)
        with pytest.raises(CheckpointError, match="is damaged"):
            statefile.read(path)
    path.write_bytes(whole)
    statefile.read(path)
    path.unlink()
    with pytest.raises(CheckpointError, match="cannot be read"):
        statefile.read(path)


def test_another_format_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(statefile, "FORMAT", 99)
    path = made(tmp_path)
    monkeypatch.undo()
    with pytest.raises(CheckpointError, match="has format 99"):
        statefile.read(path)


def test_what_cannot_be_written_leaves_nothing(tmp_path):
    """A limit to a file's size stands for a full disk: the old one stays, no part of the new."""
    path = made(tmp_path)
    whole = path.read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    big = {"nodes/x": np.zeros(1 << 16)}
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 17, hard))
        with pytest.raises(OSError, match="too large"):
            statefile.write(path, ABOUT, iter(big.items()))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == whole
    assert os.listdir(tmp_path) == [path.name]
    json.dumps(statefile.read(path)[0])
