# SPDX-License-Identifier: LGPL-3.0-or-later
"""Runs that are killed at random moments, on 1 and 2 ranks, and a day in fast motion.

Nothing that was written is lost, and a resumed run ends as one that was never killed.
"""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from written import read

from complexbody import statefile

pytestmark = [pytest.mark.serial, pytest.mark.slow]

FIELDS = ("u", "nu", "stress")
SCENE = '''
import os, resource
import numpy as np
import complexbody as cb
from complexbody import meshes
from complexbody.forms import isotropic_two_field

# As if the disk were full, once MPI has the files that it needs.
if "FILE_LIMIT" in os.environ:
    most = int(os.environ["FILE_LIMIT"]), resource.RLIM_INFINITY
    resource.setrlimit(resource.RLIMIT_FSIZE, most)

def scene(comm, cells=12):
    return cb.Scene(
        meshes.jiggled(meshes.rectangle(comm, (0, 0), (2, 1), (2 * cells, cells)), 0.2),
        isotropic_two_field(d=2, viscosity=0.05, name="rubber"),
        supports=[cb.Fix("u", lambda x: x[0] < 1e-9, 0.1, history=cb.sine(0.7))],
        loads=[cb.Traction(lambda x: x[0] > 2 - 1e-9, (0.2, 0.1), cb.sine(1.3))],
        initial=cb.Initial(nu=lambda x: np.array([np.cos(2 * x[0]), x[1]])),
        name="bar",
    )
'''


def started(words, ranks, limit=None):
    """A process of the command line, the first of a session, whose files may have so many bytes."""
    extra = {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
    mpirun = ["mpirun", "--oversubscribe", "--bind-to", "none", "-n", str(ranks)]
    if limit is not None:
        extra["FILE_LIMIT"] = str(limit)
    return subprocess.Popen(
        [*(mpirun if ranks > 1 else []), sys.executable, "-m", "complexbody", *map(str, words)],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
        env={**os.environ, **extra},
    )  # fmt: skip


def killed(process, folder, rng, spread):
    """Kill all of it at a random time after it has begun to go on; False if it ended before."""
    begun = begun_at(folder)
    while begun_at(folder) == begun and process.poll() is None:
        time.sleep(0.01)
    deadline = time.monotonic() + rng.uniform(0.0, spread)
    while time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.001)
    if process.poll() is not None:
        text = process.communicate()[0]
        assert process.returncode == 0, text
        return False
    # All ranks at once, and mpirun before them, lest it puts things in order.
    os.kill(process.pid, signal.SIGSTOP)
    for pid in children(process.pid):
        os.kill(pid, signal.SIGKILL)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    return True


def children(pid):
    """Processes that a process has started."""
    found = subprocess.run(["ps", "-o", "pid=", "--ppid", str(pid)], capture_output=True, text=True)
    return [int(word) for word in found.stdout.split()]


def begun_at(folder):
    """What changes when a run has begun or goes on."""
    try:
        return json.loads((folder / "run.json").read_text())["started"], rows(folder)
    except (OSError, ValueError, KeyError):
        return None


def rows(folder):
    """Rows of the ledger, all whole."""
    path = folder / "ledger.csv"
    return len(path.read_bytes().splitlines()) if path.exists() else 0


def intact(folder, reference):
    """All that is written can be read, at the times of the reference, one after the other."""
    for name in FIELDS:
        path = folder / f"{name}.xdmf"
        if not path.exists():
            continue
        steps, known = read(path)[2], reference[name]
        assert [s[0] for s in steps] == [s[0] for s in known[: len(steps)]]
        if steps:
            np.testing.assert_array_equal(steps[-1][2], known[len(steps) - 1][2])
    kept = statefile.listed(folder / "checkpoints")
    for path in kept:
        statefile.read(path)
    return len(kept)


def ended(process):
    text = process.communicate(timeout=600)[0]
    assert process.returncode == 0, text


@pytest.mark.parametrize(("ranks", "kills"), [(1, 40), (2, 10)])
def test_kills_at_random(tmp_path, ranks, kills):
    """Outputs, rows and fields to the last bit, on 2 ranks as well: the parts are the same."""
    file, rng = tmp_path / "scene.py", np.random.default_rng(ranks)
    file.write_text(SCENE)
    words = ["run", file, "--until", 12, "--every", 0.05, "--fields", ",".join(FIELDS),
             "--probe", "tip=2,1", "--checkpoint-steps", 25, "--no-picture", "--out"]  # fmt: skip
    whole = tmp_path / "whole"
    ended(started([*words, whole], ranks))
    reference = {name: read(whole / f"{name}.xdmf")[2] for name in FIELDS}
    done = lives = 0
    while done < kills:
        folder = tmp_path / f"life-{lives}"
        lives += 1
        process = started([*words, folder], ranks)
        while killed(process, folder, rng, 1.5):
            done += 1
            checkpoints = intact(folder, reference)
            if json.loads((folder / "run.json").read_text())["state"] == "finished":
                break  # killed behind the end: the next life
            again = ["resume", folder] if checkpoints else [*words, folder]
            process = started(again, ranks)
        intact(folder, reference)
        for name in ("ledger.csv", "probe-tip.csv"):
            assert (folder / name).read_bytes() == (whole / name).read_bytes()
        for name in FIELDS:
            steps = read(folder / f"{name}.xdmf")[2]
            assert len(steps) == len(reference[name])
            for one, other in zip(steps, reference[name], strict=True):
                np.testing.assert_array_equal(one[2], other[2])
    print(f"{done} kills on {ranks} rank(s) in {lives} lives")


def test_a_day_in_fast_motion(tmp_path):
    """Ten million cell updates and more: kills, full disks, signals; a closed ledger."""
    file, rng = tmp_path / "scene.py", np.random.default_rng(5)
    file.write_text(SCENE)
    words = ["run", file, "--set", "cells=24", "--until", 100, "--every", 2, "--no-picture",
             "--fields", "u,nu,stress", "--checkpoint-every", 0.5, "--out"]  # fmt: skip
    whole, folder = tmp_path / "whole", tmp_path / "day"
    ended(started([*words, whole], 1))
    process, events = started([*words, folder], 1), []
    for event in range(12):
        if event % 4 == 2:  # no file may be larger than this: as if the disk were full
            text = process.communicate(timeout=600)[0]
            assert process.returncode in (0, 2), text
            events.append("full" if process.returncode else "end")
            if process.returncode:
                assert "too large" in text and "Make room" in text
        elif event % 4 == 3:
            process.send_signal(signal.SIGTERM)
            process.communicate(timeout=600)
            events.append("term")
        elif killed(process, folder, rng, 2.0):
            events.append("kill")
        resumes = bool(statefile.listed(folder / "checkpoints"))
        limit = 60_000 if event % 4 == 1 else None
        process = started(["resume", folder] if resumes else [*words, folder], 1, limit)
    ended(process)
    assert (whole / "ledger.csv").read_bytes() == (folder / "ledger.csv").read_bytes()
    record = json.loads((folder / "run.json").read_text())
    assert record["statistics"]["updates"] >= 1e7
    assert abs(record["ledger"]["identity"]) < 1e-9
    assert {"kill", "full"} <= set(events), events
    print(f"{events}, {record['statistics']['updates']} cell updates")
