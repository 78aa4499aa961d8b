# SPDX-License-Identifier: LGPL-3.0-or-later
"""Case 5: R = √(AK)(1 − δ), the edge of coercivity: slow mode right, δ < 0 refused by its mode."""

import warnings

import numpy as np
import pytest
from dense import prepared, state
from harness import refused
from mpi4py import MPI

import complexbody as cb
from complexbody import meshes
from complexbody.errors import CoercivityError
from complexbody.problem import Problem


def pair(R, A=1.0, K=1.0):
    def energy(U, nu, N):
        squares = 0.5 * A * U[0, 0] ** 2 + 0.5 * K * N[0, 0] ** 2
        return squares + R * U[0, 0] * N[0, 0]

    return cb.Body(1, energy, 1.0, 1.0, displacement=1)


@pytest.mark.serial  # up to 15 000 steps of 20 cells
@pytest.mark.parametrize("power", [2, 3, 4, 5, 6])
def test_almost_incoercive(power):
    """R = √(AK)(1 − δ): the slow mode keeps its frequency π√δ, as far as the scheme can know."""
    delta, cells = 10.0**-power, 20
    mesh = meshes.interval(MPI.COMM_SELF, 0, 1, cells)
    sides = [cb.Fix("u", "boundary"), cb.Fix("nu", "boundary")]
    sine = lambda x: np.sin(np.pi * x[:1])  # noqa: E731
    initial = cb.Initial(sine, lambda x: -sine(x))
    scene = cb.Scene(mesh, pair(1 - delta), sides, initial=initial)
    slow = (1 - (1 - delta)) * 4 * cells**2 * np.sin(np.pi / (2 * cells)) ** 2
    run = prepared(scene, cb.Synchronous())
    omega = 2 / run.step * np.arcsin(0.5 * run.step * np.sqrt(slow))
    assert omega == pytest.approx(np.pi * np.sqrt(delta), rel=0.01)
    steps = int(0.4 * np.pi / omega / run.step)
    for _ in range(4):
        run.advance(steps)
        field, _ = state(run)
        amplitude = field[cells // 2]
        cosine = np.cos(omega * run.time)
        assert abs(amplitude - [cosine, -cosine]).max() < 1e-8


METHODS = {
    "one step": cb.Synchronous(),
    "balanced": cb.AVI(),
    "plain": cb.AVI(balanced=False),
    "real steps": cb.AVI(schedule="exact"),
    "local leapfrog": cb.LocalLeapfrog(),
}


def frequency_error(method, delta):
    """Relative error of the slow mode's frequency on cells of sizes in [1, 3], beside π√δ."""
    sizes = np.random.default_rng(7).uniform(1.0, 3.0, 20)
    mesh = meshes.graded_interval(MPI.COMM_SELF, sizes / sizes.sum())
    sides = [cb.Fix("u", "boundary"), cb.Fix("nu", "boundary")]
    sine = lambda x: np.sin(np.pi * x[:1])  # noqa: E731
    scene = cb.Scene(mesh, pair(1 - delta), sides, initial=cb.Initial(sine, lambda x: -sine(x)))
    omega = np.pi * np.sqrt(delta)
    run = prepared(scene, method, 2.0 / omega)
    run.advance(round(2.0 / omega / run.step))
    disc = run.problem.disc
    weight = disc.volume * np.sin(np.pi * disc.position[:-1, 0])
    field, rate = (weight @ (r[:-1, 0] - r[:-1, 1]) for r in run.sample())
    return np.arctan2(-rate / omega, field) / run.time / omega - 1


@pytest.mark.serial
@pytest.mark.parametrize("name", METHODS)
def test_no_worse_towards_the_edge(name):
    """The error at δ = 1e-2, 1e-4, 1e-6 is the mesh's, whatever the method: no trace of 1/δ."""
    found = np.array([frequency_error(METHODS[name], 10.0**-p) for p in (2, 4, 6)])
    assert found == pytest.approx(-1.4125e-3, rel=0.01)  # -(π/20)²/24 = -1.03e-3 if uniform
    assert found[1:] == pytest.approx(found[-1], rel=1e-3)


@pytest.mark.parametrize("delta", [-1e-2, -1e-4, -1e-6, -1e-9])
def test_incoercive(comm, delta):
    """δ < 0 is refused, by its mode, whatever the units of ν."""
    for K in (1.0, 1e-18, 1e12):
        body = pair(np.sqrt(K) * (1 - delta), K=K)
        mode = ("U11", "N11") if K == 1.0 else ()
        with refused(CoercivityError, "not coercive", *mode):
            Problem(cb.Scene(meshes.interval(comm, 0, 1, 5), body))


def test_semidefinite(comm):
    """δ = 0 runs, with a warning that names what only the boundary holds."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        Problem(cb.Scene(meshes.interval(comm, 0, 1, 5), pair(1.0)))
    words = [str(w.message) for w in told if w.category is UserWarning]
    if comm.rank == 0:
        assert len(words) == 1 and "U11" in words[0] and "N11" in words[0]
