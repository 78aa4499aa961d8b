# SPDX-License-Identifier: LGPL-3.0-or-later
"""Files while they grow: read meanwhile, resumed, refused; tables to the last digit."""

from __future__ import annotations

import csv
import os
import resource
import shutil
import subprocess
import sys
from contextlib import ExitStack

import numpy as np
import pytest
from written import body, domain, fields, read, wavy

from complexbody import series
from complexbody.action import Action
from complexbody.errors import OutputError
from complexbody.files import CsvWriter
from complexbody.output import Output, Writer
from complexbody.scene import Scene

WATCH = "import h5py, sys; file = h5py.File(sys.argv[1]); print('open', flush=True); input()"


def test_reading_while_writing(comm, shared_path):
    """Between steps all is complete; who keeps the file open for reading does not stop the run."""
    pytest.importorskip("h5py")
    scene = Scene(domain(comm, 2), body())
    with Writer(Action(scene), Output(shared_path, fields="u")) as writer, ExitStack() as stack:
        for number in range(3):
            writer.write(float(number), fields(scene, wavy))
            if comm.rank == 0:
                assert len(read(shared_path / "u.xdmf")[2]) == number + 1
                if number == 0:
                    command = [sys.executable, "-c", WATCH, shared_path / "u.h5"]
                    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
                    watcher = subprocess.Popen(command, env=dict(os.environ), **pipes)
                    stack.callback(watcher.communicate, "enough\n")
                    assert watcher.stdout.readline() == "open\n"
    if comm.rank == 0:
        assert len(read(shared_path / "u.xdmf")[2]) == 3


def test_resume_goes_on(comm, shared_path):
    """What was written up to then stays, what came later is written anew; else all is new."""
    scene = Scene(domain(comm, 2), body())
    output = Output(shared_path, fields=["u", "stress"])
    for resume, begin, times in (
        (None, 0, [0, 1, 2, 3]),
        (1.5, 1, [0, 1, 2, 3]),
        (None, 2, [2, 3]),
    ):
        with Writer(Action(scene), output, resume=resume) as writer:
            for time in range(begin, 4):
                writer.write(
                    time, fields(scene, lambda x, i, b=begin, t=time: (10 * b + t) + 0 * x[0])
                )
        comm.barrier()
        if comm.rank == 0:
            steps = read(shared_path / "u.xdmf")[2]
            assert [step[0] for step in steps] == times
            values = [step[2][0, 0] for step in steps]
            assert values == {0: [0, 1, 2, 3], 1: [0, 1, 12, 13], 2: [22, 23]}[begin]
            assert len(read(shared_path / "stress.xdmf")[2]) == len(times)
        comm.barrier()
    with pytest.raises(OutputError, match="another mesh"):
        Writer(Action(Scene(domain(comm, 1), body())), output, resume=1.0)


def test_unwritable_folders(comm, shared_path):
    """A file where the folder should be: all ranks say so, before and during the run."""
    scene = Scene(domain(comm, 2), body())
    if comm.rank == 0:
        (shared_path / "file").write_text("in the way")
    comm.barrier()
    for place in ("file", "file/results"):
        with pytest.raises(OutputError, match="cannot be written"):
            Writer(Action(scene), Output(shared_path / place))
        with pytest.raises(OutputError, match="cannot be written"):
            CsvWriter(shared_path / place / "t.csv", {"time": "s"}, comm)
    writer = Writer(Action(scene), Output(shared_path / "gone"))
    if comm.rank == 0:
        shutil.rmtree(shared_path / "gone")
    comm.barrier()
    with pytest.raises(OutputError, match="cannot be written"):
        writer.write(0.0, fields(scene, wavy))


def test_a_full_disk(comm, shared_path):
    """All ranks say so; what is there stays readable, and goes on when there is room again.

    A limit to the size of files stands for it: the system refuses in the same place.
    """
    scene = Scene(domain(comm, 2), body())
    writer = Writer(Action(scene), Output(shared_path, fields="u"))
    table = CsvWriter(shared_path / "t.csv", {"time": "s"}, comm)
    writer.write(0.0, fields(scene, wavy))
    table.write([[0.0]])
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, limits[1]))
        with pytest.raises(OutputError, match="File too large"):
            writer.write(1.0, fields(scene, wavy))
        with pytest.raises(OutputError, match="File too large"):
            table.write([[float(i)] for i in range(1000)])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    comm.barrier()
    assert [step[0] for step in read(shared_path / "u.xdmf")[2]] == [0.0]
    assert (shared_path / "t.csv").read_text() == "time [s]\n0.0\n"
    comm.barrier()
    writer.write(2.0, fields(scene, wavy))
    table.write([[2.0]])
    comm.barrier()
    assert [step[0] for step in read(shared_path / "u.xdmf")[2]] == [0.0, 2.0]
    assert (shared_path / "t.csv").read_text() == "time [s]\n0.0\n2.0\n"
    assert not list(shared_path.glob("*.part"))
    table.close()


def test_many_steps_are_in_several_files(comm, shared_path, monkeypatch):
    """A file is closed for good when it is full or has been synchronised; the index knows all."""
    monkeypatch.setattr(series, "STEPS", 3)
    scene, output = Scene(domain(comm, 2), body()), Output(shared_path, fields="u")

    def write(writer, times):
        for time in times:
            writer.write(time, fields(scene, lambda x, i, t=time: t + 0 * x[0]))

    def seen():
        comm.barrier()
        found = [(step[0], step[2][0, 0]) for step in read(shared_path / "u.xdmf")[2]]
        comm.barrier()
        return [time for time, value in found if time == value]

    writer = Writer(Action(scene), output)
    write(writer, range(4))
    writer.sync()
    write(writer, range(4, 9))
    assert seen() == [*range(9)]
    names = sorted(path.name for path in shared_path.glob("u*.h5"))
    assert names == ["u-000003.h5", "u-000004.h5", "u-000007.h5", "u.h5"]
    writer = Writer(Action(scene), output, resume=5.5)
    assert seen() == [*range(6)]
    assert sorted(path.name for path in shared_path.glob("u*.h5")) == [names[0], names[1], "u.h5"]
    write(writer, range(3, 8))
    assert seen() == [*range(8)]
    if comm.rank == 0:
        (shared_path / "u.xdmf").unlink()
    comm.barrier()
    Writer(Action(scene), output, resume=100.0)
    assert seen() == [*range(8)]
    Writer(Action(scene), output)
    comm.barrier()
    assert [path.name for path in shared_path.glob("u*.h5")] == ["u.h5"]


def test_tables(comm, shared_path):
    """Headers have units, numbers come back to the last digit, rows are there once written."""
    path = shared_path / "tables" / "ledger.csv"
    columns = {"time": "s", "steps": "", "energy, total": "J"}
    rows = [[0.1 + 0.2, 1, np.float64(1) / 3], [1e-300, 2, -np.pi], [5.0, 3, float("nan")]]
    with CsvWriter(path, columns, comm) as table:
        for row in rows:
            table.write([row] if comm.rank == 0 else [])
            if comm.rank == 0:
                header, *found = csv.reader(path.read_text().splitlines())
                assert len(found) == rows.index(row) + 1
    if comm.rank == 0:
        assert header == ["time [s]", "steps", "energy, total [J]"]
        np.testing.assert_array_equal(np.array(found, dtype=float), np.array(rows, dtype=float))
    comm.barrier()
    with CsvWriter(path, columns, comm, resume=1.0) as table:
        table.write([[2.0, 4, 0.0]])
    if comm.rank == 0:
        assert [line.split(",")[1] for line in path.read_text().splitlines()[1:]] == ["1", "2", "4"]
    comm.barrier()
    with pytest.raises(OutputError, match="other columns"):
        CsvWriter(path, {"time": "s"}, comm, resume=1.0)
