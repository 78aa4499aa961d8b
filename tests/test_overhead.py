# SPDX-License-Identifier: LGPL-3.0-or-later
"""What accompanies the steps must not cost much beside them. Ratios, never bare times."""

import time
import tracemalloc

import numpy as np
import pytest
from dense import prepared

import complexbody as cb
from complexbody import meshes
from complexbody.forms import scaled_icosahedral_quasicrystal
from complexbody.simulation import Simulation

pytestmark = [pytest.mark.slow, pytest.mark.serial]


def impact(comm, cells, moving=False):
    """A bar of quasicrystal, hit at one end and held, or moved, at the other."""
    mesh = meshes.box(comm, (0, 0, 0), (2, 1, 1), (2 * cells, cells, cells))
    history = cb.ramp(1.0) if moving else cb.constant()
    return cb.Scene(
        mesh,
        scaled_icosahedral_quasicrystal(),
        [cb.Fix("u", lambda x: x[0] > 2 - 1e-9, (0.1 if moving else 0.0, 0, 0), history=history)],
        [cb.Traction(lambda x: x[0] < 1e-9, (1, 0, 0), cb.ricker(1.0))],
    )


@pytest.mark.parametrize("cells, steps", [(6, 50_000), (12, 6_000)])
def test_ledger_by_default(comm, cells, steps):
    """The books of a long run cost less than 10 % of it: processor time, the best of five."""
    scene, taken = impact(comm, cells), {None: [], 10**9: []}
    until = prepared(scene, cb.Synchronous()).step * steps
    for _ in range(5):
        for ledger_steps, times in taken.items():
            simulation = Simulation(scene, until=until, ledger_steps=ledger_steps)
            begun = time.process_time()
            rows = len(simulation.run().ledger)
            times.append(time.process_time() - begun)
            assert rows == 2 if ledger_steps else rows > 100
    assert min(taken[None]) < 1.1 * min(taken[10**9]), taken


@pytest.mark.parametrize("moving", [False, True])
def test_steps_allocate_nothing(comm, moving):
    """Steps keep nothing, and hold beside the state some numbers per load and step at most."""
    run = prepared(impact(comm, 12, moving), cb.Synchronous())
    run.advance(1000)
    state, found = run.problem.kernels.x.nbytes, []
    tracemalloc.start()
    try:
        for steps in (500, 1000):
            before = tracemalloc.get_traced_memory()[0]
            tracemalloc.reset_peak()
            run.advance(steps)
            after, peak = tracemalloc.get_traced_memory()
            found.append((after - before, peak - before))
    finally:
        tracemalloc.stop()
    (_, _), (kept, most) = found
    # The amplitudes of a stretch are computed before it, and their temporaries are as long.
    assert most < 8 * 1000 * 8 < 0.25 * state
    assert kept < 1024 < 0.005 * state
    assert np.isfinite(run.problem.kernels.x).all()
