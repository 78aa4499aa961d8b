# SPDX-License-Identifier: LGPL-3.0-or-later
"""Case 6: nearly incompressible bodies lock on P1 cells: warned; slivers: their altitude rules."""

import warnings

import numpy as np
import pytest
import ufl
from dense import prepared
from mpi4py import MPI
from verification.step_maps import EVERYWHERE, frequencies
from verification.waves import STIFF, pair

import complexbody as cb
from complexbody import _compat, meshes
from complexbody.coercivity import LOCKING
from complexbody.problem import Problem
from complexbody.timesets import cell_steps, critical_step

STOKES = 52.3447  # least eigenvalue of the Stokes operator on the unit square, held (recalled)


def square(comm, ratio, cells=4):
    """An elastic square, μ = ρ = 1 and λ = ratio, held at its sides; ν is idle."""

    def energy(U, nu, N):
        e = ufl.sym(ufl.as_tensor([[U[i, j] for j in range(2)] for i in range(2)]))
        return 0.5 * ratio * ufl.tr(e) ** 2 + ufl.inner(e, e) + 0.5 * ufl.inner(N, N)

    mesh = meshes.rectangle(comm, (0, 0), (1, 1), cells)
    body = cb.Body(1, energy, 1.0, 1.0, displacement=2, name="rubber")
    return cb.Scene(mesh, body, [cb.Fix("u", "boundary"), cb.Fix("nu", EVERYWHERE)])


def slowest(ratio, cells):
    """Its lowest ω² on P1 cells; exact values rise with λ towards STOKES."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return frequencies(Problem(square(MPI.COMM_SELF, ratio, cells)))[0]


@pytest.mark.parametrize("ratio", [49.0, 51.0, 1e4])
def test_locking_is_told(comm, ratio):
    """From λ/μ = 50 on a warning with the number, before the run."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        problem = Problem(square(comm, ratio))
    notes = problem.warnings
    assert len(notes) == (ratio >= LOCKING)
    assert comm.rank or [str(w.message) for w in caught if w.category is UserWarning] == notes
    if notes:
        assert "rubber" in notes[0] and f"λ/μ = {ratio:.3g}" in notes[0] and "lock" in notes[0]


@pytest.mark.serial
def test_what_locking_does():
    """At least so much too high: on 16 cells per side 16 % at the bound, 145 % at 1000."""
    excess = {r: np.sqrt(slowest(r, 16) / STOKES) - 1 for r in (LOCKING, 1e3)}
    assert excess[LOCKING] == pytest.approx(0.16, abs=0.01)
    assert excess[1e3] == pytest.approx(1.45, abs=0.03)
    assert slowest(1.0, 16) / slowest(1.0, 12) == pytest.approx(1, abs=0.01)  # where nothing locks
    assert np.sqrt(slowest(LOCKING, 8) / STOKES) - 1 > 2.5 * excess[LOCKING]  # refinement helps


# --- slivers --------------------------------------------------------------------------------------

FLAT = {  # vertices, the last at a height ε over the others' line or plane
    "triangle": lambda e: [[0, 0], [1, 0], [0.4, e]],
    "tetrahedron, a cap": lambda e: [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.3, 0.3, e]],
    "tetrahedron, a sliver": lambda e: [[0, 0, 0], [1, 1, 0], [1, 0, e], [0, 1, e]],
}


C2 = np.linalg.eigvalsh(STIFF)[-1]  # square of the pair's faster wave speed


@pytest.mark.serial
@pytest.mark.parametrize("name", FLAT)
def test_the_step_follows_the_altitude(name):
    """Of a flat cell alone: 2/c√((d+1) Σ 1/a²), a its altitudes; slope 1 over five decades."""
    heights, found = 10.0 ** -np.arange(1.0, 7.0), []
    for height in heights:
        points = np.array(FLAT[name](height), dtype=float)
        dim = points.shape[1]
        mesh = _compat.create_mesh(MPI.COMM_SELF, np.arange(dim + 1)[None], points)
        step = critical_step(Problem(cb.Scene(mesh, pair(dim, own=0.0))))
        inverse = np.linalg.inv(points[1:] - points[0])  # its columns: gradients, 1/a long
        squares = np.sum(np.column_stack([inverse, -inverse.sum(axis=1)]) ** 2)
        found.append([step, 2 / np.sqrt(C2 * (dim + 1) * squares)])
    steps, flat = np.array(found).T
    assert np.all(steps >= flat * (1 - 1e-9))  # the trace bounds the largest eigenvalue
    assert steps[1:] == pytest.approx(flat[1:], rel=1e-3)
    slopes = np.diff(np.log(steps)) / np.diff(np.log(heights))
    assert slopes[1:] == pytest.approx(1, abs=1e-4)


def pierced(height, cells=8):
    """A square; one vertex lies ``height`` before a side of its hexagon of cells: one sliver."""
    mesh = meshes.rectangle(MPI.COMM_SELF, (0, 0), (1, 1), cells)
    x, size = mesh.geometry.x, 1 / cells
    vertex = np.argmin(np.linalg.norm(x - [0.5, 0.5, 0], axis=1))
    x[vertex, :2] += [size - height, 0.5 * size]
    assert np.isclose(meshes.altitudes(mesh).min(), height)
    supports = [cb.Fix("u", "boundary"), cb.Fix("nu", "boundary")]
    smooth = lambda x: np.sin(np.pi * x[:1]) * np.sin(np.pi * x[1:2])  # noqa: E731
    return cb.Scene(mesh, pair(2), supports, initial=cb.Initial(u=smooth, nu=smooth))


@pytest.mark.serial
def test_the_body_forgives_more_than_the_cell():
    """A sliver has little volume, and its nodes other cells' mass: the body's step goes as √ε."""
    pytest.importorskip("slepc4py")
    own, cells = [], []
    for height in (1e-4, 1e-6):
        problem = Problem(pierced(height))
        own.append(critical_step(problem, how="global"))
        cells.append(critical_step(problem))
    assert np.log(cells[0] / cells[1]) / np.log(100) == pytest.approx(1, abs=0.01)
    assert np.log(own[0] / own[1]) / np.log(100) == pytest.approx(0.5, abs=0.01)
    assert own[0] > 40 * cells[0]


METHODS = {  # at ε = 1e-3: Σ 1/h_K saves 52 times; what the schedule leaves of it
    "real steps": (cb.AVI(schedule="exact"), 0.5),
    "plain": (cb.AVI(balanced=False), 0.24),
    "balanced": (cb.AVI(), 0.045),
    "local leapfrog": (cb.LocalLeapfrog(), 1.13),
}


@pytest.mark.serial
@pytest.mark.parametrize("name", METHODS)
def test_what_local_steps_save(name):
    """One sliver of 128 cells: the saving is Σ 1/h_K against N/h_min, up to N; and it is stable."""
    ideal = []
    for height in (1e-2, 1e-3, 1e-5):
        scene = pierced(height)
        critical = cell_steps(Problem(scene))
        critical = critical[np.isfinite(critical)]
        assert len(critical) == 128
        run = prepared(scene, METHODS[name][0], 1.0)
        sets = run.time_sets
        ideal.append(sets.ideal)
        assert sets.ideal == pytest.approx(128 / critical.min() / np.sum(1 / critical))
        if height != 1e-3:
            continue
        assert sets.scheduled == pytest.approx(METHODS[name][1] * sets.ideal, rel=0.05)
        energies = []
        for _ in range(20):
            run.advance(20)
            e = run.entries()
            energies.append(e.kinetic_u + e.kinetic_nu + e.stored)
        assert max(energies) < 1.05 * min(energies)
        # Steps at 0.9 of the smallest cell's, for as long as the run took, over what it did.
        synchronous = 128 * run.time / (0.9 * critical.min())
        assert synchronous / run.updates == pytest.approx(sets.scheduled, rel=0.03)
    assert ideal[0] == pytest.approx(8.2, rel=0.01)
    assert 0.95 * 128 < ideal[-1] < 128
