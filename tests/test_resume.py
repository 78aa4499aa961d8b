# SPDX-License-Identifier: LGPL-3.0-or-later
"""Which checkpoint is taken, when one is made, and what happens where none can be."""

import os
import signal
import subprocess
from contextlib import nullcontext
from dataclasses import dataclass, replace

import numpy as np
import pytest
from harness import refused
from resumed import cut, same_files, same_result, simulated
from test_checkpoint import plain_scene
from written import read

import complexbody as cb
from complexbody import statefile
from complexbody.amplitudes import TRIED
from complexbody.errors import CheckpointError, DivergenceError, OutputError
from complexbody.together import Interrupted

STEPS = cb.Checkpoint(None, 5, keep=1000)
METHOD = cb.Synchronous(0.02)


def test_a_damaged_or_foreign_one_is_not_used(comm, shared_path):
    """The one before it is; if there is none, the error names the newest and why."""
    scene = plain_scene(comm)
    whole = simulated(scene, METHOD, 0.5, shared_path / "whole", checkpoint=STEPS)
    cut(comm, shared_path / "whole", shared_path / "again", 2)
    kept = shared_path / "again" / "checkpoints"
    newest = statefile.path_of(kept, 15)
    if comm.rank == 0:
        newest.write_bytes(newest.read_bytes()[:-100])
        (kept / "step-000000000020.npz.part").write_text("killed here")
    comm.barrier()
    told = pytest.warns(UserWarning, match="15.npz is damaged") if comm.rank == 0 else nullcontext()
    with told:
        again = {"checkpoint": STEPS, "resume": True}
        resumed = simulated(scene, METHOD, 0.5, shared_path / "again", **again)
    same_result(comm, whole, resumed)
    same_files(comm, shared_path / "whole", shared_path / "again")
    if comm.rank == 0:
        assert not list(kept.glob("*.part"))
    other = cb.Fix("nu", lambda x: x[0] > 1 - 1e-9)
    pull = replace(scene.loads[0], vector=(0.3, -0.21))
    later = replace(scene.loads[0], history=cb.sine(0.8))
    heavy = replace(scene.body, density=1.31)
    stiff = replace(scene.body, energy=lambda U, nu, N: 1.0001 * scene.body.energy(U, nu, N))
    for what, changed, method in (
        ("another mesh", {"mesh": None}, METHOD),
        ("other bodies", {"body": heavy}, METHOD),
        ("other bodies", {"body": stiff}, METHOD),
        ("other supports", {"supports": [*scene.supports, other]}, METHOD),
        ("other loads", {"loads": [pull]}, METHOD),
        ("other loads", {"loads": [later]}, METHOD),
        ("other initial data", {"initial": cb.Initial(nu=lambda x: np.sin(x[:1]))}, METHOD),
        ("another integrator", {}, cb.Synchronous(0.01)),
        ("another integrator", {}, cb.AVI()),
    ):
        if "mesh" in changed:
            moved = plain_scene(comm)
            moved.mesh.geometry.x[:, 1] *= 1 + 1e-6
        else:
            moved = replace(scene, **changed)
        with refused(CheckpointError, what, "15.npz"):
            cb.simulate(moved, method, until=0.5, resume=shared_path / "whole" / "checkpoints" /
                        "step-000000000015.npz")  # fmt: skip
    with refused(CheckpointError, "No checkpoint in"):
        cb.simulate(scene, METHOD, until=0.5, resume=shared_path / "nowhere")
    with refused(CheckpointError, "already"):
        cb.simulate(scene, METHOD, until=0.2, resume=shared_path / "whole")


def test_a_later_end(comm, shared_path):
    """A finished run goes on: the same as one that was to last so long, with the same step."""
    scene = plain_scene(comm)
    whole = simulated(scene, METHOD, 0.8, shared_path / "whole", checkpoint=STEPS)
    again = simulated(scene, METHOD, 0.8, shared_path / "whole", checkpoint=STEPS, resume=True)
    same_result(comm, whole, again)  # nothing is left to be done, and nothing is done twice
    folder = shared_path / "short"
    simulated(scene, METHOD, 0.5, folder, checkpoint=STEPS)
    resumed = simulated(scene, METHOD, 0.8, folder, checkpoint=STEPS, resume=True)
    for name in ("u", "nu", "u_dot", "nu_dot"):
        np.testing.assert_array_equal(
            getattr(whole, name).x.array, getattr(resumed, name).x.array
        )
    assert resumed.ledger["time"][-1] == whole.ledger["time"][-1]
    assert np.all(np.diff(resumed.ledger["time"]) > 0)
    if comm.rank == 0:
        times = [step[0] for step in read(folder / "u.xdmf")[2]]
        assert np.all(np.diff(times) > 0) and times[-1] == 0.8 and 0.5 in times


@dataclass(frozen=True)
class Signalling:
    """A constant load that sends a signal to its own process when it is first asked about t."""

    number: int
    t: float

    def __call__(self, t):
        """The factor 1 at the times t."""
        trial = np.size(t) == TRIED  # before the run, when nobody listens
        if np.max(t) > self.t and not trial and not SENT:
            SENT.append(os.kill(os.getpid(), self.number))
        return np.ones_like(np.asarray(t, dtype=float))


SENT = []


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGUSR1])
def test_signals_on_all_ranks_make_one(comm, shared_path, number):
    """It ends the run, but for SIGUSR1, in good order on all ranks; a resumed one goes on."""
    scene, folder = plain_scene(comm), shared_path / "run"
    before = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)]
    load = replace(scene.loads[0], history=Signalling(int(number), 0.25 if comm.rank == 0 else 9.0))
    scene, keep = replace(scene, loads=[load]), cb.Checkpoint(1e9)
    SENT.clear()
    if number == signal.SIGUSR1:
        whole = simulated(scene, METHOD, 0.5, folder, checkpoint=keep)
        assert comm.allreduce(len(SENT)) == 1
        if comm.rank == 0:
            assert len(statefile.listed(folder / "checkpoints")) == 2
        assert whole.stats.steps == 25
    else:
        with pytest.raises(Interrupted) as stop:
            simulated(scene, METHOD, 0.5, folder, checkpoint=keep)
        assert stop.value.exit_code == 128 + number
        resumed = simulated(scene, METHOD, 0.5, folder, checkpoint=keep, resume=True)
        whole = simulated(scene, METHOD, 0.5, shared_path / "whole")
        same_result(comm, whole, resumed)
        same_files(comm, shared_path / "whole", folder)
    assert before == [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)]


def test_the_last_good_state_of_a_run_that_diverges(comm, shared_path):
    """Later checkpoints, of a state that was lost already, are not kept."""
    scene = plain_scene(comm)
    method = cb.Synchronous(0.15, unstable_ok=True)
    with pytest.raises(DivergenceError):
        simulated(scene, method, 15.0, shared_path, checkpoint=cb.Checkpoint(None, 1))
    newest = statefile.listed(shared_path / "checkpoints")[0]
    about, arrays = statefile.read(newest)
    assert all(np.isfinite(arrays[name]).all() for name in arrays)
    assert about["time"] == arrays["ledger"][-1, 0]  # a row before the one that stopped the run
    rows = np.loadtxt(shared_path / "ledger.csv", delimiter=",", skiprows=1)
    assert about["time"] in rows[:-1, 0]
    with pytest.raises(DivergenceError):
        simulated(scene, method, 15.0, shared_path, checkpoint=STEPS, resume=True)


def test_unwritable_places(comm, shared_path):
    scene = plain_scene(comm)
    if comm.rank == 0:
        (shared_path / "checkpoints").write_text("in the way")
    comm.barrier()
    with refused(OutputError, "checkpoints"):
        simulated(scene, METHOD, 0.1, shared_path, checkpoint=STEPS)
    with refused(CheckpointError, "nothing says where"):
        cb.simulate(scene, METHOD, until=0.1, checkpoint=STEPS)
    for wrong in ({"every": 0.0}, {"steps": 0}, {"keep": 0}, {"steps": 1.5}, {"every": np.nan}):
        with pytest.raises(CheckpointError):
            cb.Checkpoint(**wrong)


@pytest.mark.serial
def test_a_disk_that_is_full(comm, tmp_path):
    """The run stops and says so; all that was written is whole, and with more room it goes on."""
    made = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=120k", "none", str(tmp_path)],
        capture_output=True, check=False,
    )  # fmt: skip
    if made.returncode:
        pytest.skip("no small file systems can be made here")
    try:
        scene, folder = plain_scene(comm), tmp_path / "run"
        with pytest.raises(OutputError, match="No space left"):
            simulated(scene, METHOD, 4.0, folder, checkpoint=cb.Checkpoint(None, 5))
        for name in ("u", "nu_dot", "stress"):
            read(folder / f"{name}.xdmf")
        np.loadtxt(folder / "ledger.csv", delimiter=",", skiprows=1)
        kept = statefile.listed(folder / "checkpoints")
        assert len(kept) == 2 and all(statefile.read(path) for path in kept)
        subprocess.run(["mount", "-o", "remount,size=8M", str(tmp_path)], check=True)
        resumed = simulated(scene, METHOD, 4.0, folder, checkpoint=STEPS, resume=True)
        whole = simulated(scene, METHOD, 4.0, tmp_path / "whole")
        same_result(comm, whole, resumed)
        same_files(comm, tmp_path / "whole", folder)
    finally:
        subprocess.run(["umount", "-l", str(tmp_path)], check=False)
