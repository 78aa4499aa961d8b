# SPDX-License-Identifier: LGPL-3.0-or-later
"""Case 8: modes without energy: checkerboards, Cosserat with Ψ = 3/2, shear of a bubbly liquid."""

import warnings

import numpy as np
import pytest
import ufl
from dolfinx import fem
from harness import largest
from mpi4py import MPI
from verification.step_maps import EVERYWHERE, frequencies

import complexbody as cb
from complexbody import _compat, meshes
from complexbody.forms import bubbly_liquid
from complexbody.problem import Problem


def told(scene):
    """The problem and its warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        problem = Problem(scene)
    return problem, problem.warnings


def box(comm, dim, cells):
    """Unit interval, square or cube."""
    if dim == 1:
        return meshes.interval(comm, 0, 1, cells)
    return (meshes.rectangle, meshes.box)[dim - 2](comm, [0] * dim, [1] * dim, cells)


# --- checkerboard ---------------------------------------------------------------------------------

K0, INERTIA, CELLS = 3.0, 0.7, 4


def checkerboard(x):
    """±1 (and 0) such that ν is zero at the middle of every cell: each has one vertex of each of
    d + 1 colours, two of which are 1 and −1."""  # noqa: D205, D209
    dim = 1 + (np.ptp(x[1]) > 0) + (np.ptp(x[2]) > 0)
    colour = np.rint(CELLS * x.sum(axis=0)).astype(int) % (dim + 1)
    return np.select([colour == 0, colour == 1], [1.0, -1.0])[None]


def still(U, nu, N):
    """Self-action, and as little else as keeps A1."""
    return 0.5 * K0 * nu[0] ** 2 + 1e-12 * (ufl.inner(U, U) + ufl.inner(N, N))


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("action, factor", [("consistent", lambda d: 1 / (d + 2)), ("lumped", 1.0)])
def test_checkerboard(comm, dim, action, factor):
    """One point per cell gives it no energy; here ω² = k₀/ρ̄(d+2) exactly, or k₀/ρ̄ lumped."""
    mesh = box(comm, dim, CELLS)
    body = cb.Body(1, still, 1.0, INERTIA, displacement=1)
    initial = cb.Initial(nu=checkerboard)
    scene = cb.Scene(mesh, body, [cb.Fix("u", EVERYWHERE)], initial=initial, self_action=action)
    nu = fem.Function(_compat.vector_space(mesh, 1))
    nu.interpolate(checkerboard)
    one_point = ufl.dx(domain=mesh, metadata={"quadrature_degree": 0})
    energies = [
        comm.allreduce(fem.assemble_scalar(_compat.form(0.5 * K0 * ufl.inner(nu, nu) * measure)))
        for measure in (one_point, ufl.dx(domain=mesh))
    ]
    assert energies[0] < 1e-25 < 0.05 < energies[1]
    omega = np.sqrt(K0 / INERTIA * (factor(dim) if callable(factor) else factor))
    result = cb.simulate(scene, cb.Synchronous(0.01 / omega), until=2.0 / omega, ledger_steps=1)
    start = fem.Function(nu.function_space)
    start.interpolate(checkerboard)
    wrong = result.nu.x.array - np.cos(2.0) * start.x.array
    assert largest(comm, wrong) < 1e-4
    if action == "consistent":
        assert result.ledger["stored"][0] == pytest.approx(energies[1], rel=1e-9)


# --- Cosserat -------------------------------------------------------------------------------------

LAMBDA, MU, KAPPA, J = 1.2, 1.0, 0.3, 0.2


def cosserat(psi, beta=0.3, gamma=0.5):
    """Cosserat solid in space, ν = φ; Ψ = (β + γ)/(α + β + γ) is 3/2 where 3α + β + γ = 0."""
    alpha = (beta + gamma) * (1 / psi - 1)

    def energy(U, nu, N):
        e = ufl.sym(U)
        turn = [U[2, 1] - U[1, 2], U[0, 2] - U[2, 0], U[1, 0] - U[0, 1]]
        relative = ufl.as_vector([0.5 * turn[i] - nu[i] for i in range(3)])
        value = 0.5 * LAMBDA * ufl.tr(e) ** 2 + (MU + 0.5 * KAPPA) * ufl.inner(e, e)
        value += KAPPA * ufl.inner(relative, relative)
        value += 0.5 * (alpha * ufl.tr(N) ** 2 + beta * ufl.inner(N, N.T))
        return value + 0.5 * gamma * ufl.inner(N, N)

    return cb.Body(3, energy, 1.0, J, name="foam")


def test_cosserat_with_psi_three_halves(comm):
    """Semidefinite in tr ∇φ: warned, by its mode; more is refused in words, less is silent."""
    mesh = box(comm, 3, 2)
    assert told(cb.Scene(mesh, cosserat(1.45)))[1] == []
    notes = told(cb.Scene(mesh, cosserat(1.5)))[1]
    assert len(notes) == 1
    assert all(name in notes[0] for name in ("foam", "N11", "N22", "N33")), notes


@pytest.mark.serial
def test_cosserat_survives():
    """A free body has six motions without frequency, the rigid ones: κ holds tr ∇φ through φ."""
    mesh = box(MPI.COMM_SELF, 3, 2)
    found = [frequencies(told(cb.Scene(mesh, cosserat(psi)))[0]) for psi in (1.499, 1.5)]
    for values in found:
        assert abs(values[:6]).max() < 1e-12 * values[-1] and values[6] > KAPPA / J
    assert found[1][6:] == pytest.approx(found[0][6:], rel=0.03)
    swell = cb.Initial(nu=lambda x: x - 0.5)  # ∇φ = I
    scene = cb.Scene(mesh, cosserat(1.5), initial=swell)
    with pytest.warns(UserWarning, match="N11"):
        ledger = cb.simulate(scene, cb.Synchronous(), until=100.0, ledger_steps=1).ledger
    energy = sum(ledger[name] for name in ("kinetic_u", "kinetic_nu", "stored"))
    assert len(energy) > 500 and np.ptp(energy) < 0.2 * energy[0]
    assert abs(ledger["identity"]).max() < 1e-11
    assert ledger["stored"].min() < 0.05 * ledger["stored"].max()  # it does swing back


# --- bubbly liquid --------------------------------------------------------------------------------

SCALED = {"radius": 0.1, "void_fraction": 0.05, "density": 1.0, "sound_speed": 1.0,
          "pressure": 0.02, "gamma": 1.4}  # fmt: skip


@pytest.mark.parametrize("linearised", [True, False])
def test_bubbly_shear_is_told(comm, linearised):
    """d(d+1)/2 − 1 shears without energy; div u = aν is held by w, and not told."""
    for dim in (1, 2, 3):
        scene = cb.Scene(box(comm, dim, 2), bubbly_liquid(**SCALED, d=dim, linearised=linearised))
        _, notes = told(scene)
        assert len(notes) == dim * (dim + 1) // 2 - 1
        assert not any("nu" in note or "N1" in note for note in notes)


@pytest.mark.serial
def test_bubbly_shear_has_no_frequency():
    """Free, 2·49 motions u less 72 changes of cells' volumes: 26 zeros, no other small value."""
    scene = cb.Scene(box(MPI.COMM_SELF, 2, 6), bubbly_liquid(**SCALED, d=2, linearised=True))
    values = frequencies(told(scene)[0])
    assert np.sum(abs(values) < 1e-11 * values[-1]) == 2 * 49 - 72
    assert values[26] > 1e-3


@pytest.mark.filterwarnings("ignore:The energy of bubbly liquid does not see")
def test_bubbly_shear_flows(comm):
    """u̇ = (y, 0) goes on for ever: u = t(y, 0) to round-off, and nothing is stored."""
    body = bubbly_liquid(**SCALED, d=2, linearised=True)
    flow = cb.Initial(u_dot=lambda x: np.stack([x[1], 0 * x[1]]))
    mesh = box(comm, 2, 4)
    result = cb.simulate(cb.Scene(mesh, body, initial=flow), until=50.0)
    u = fem.Function(result.u.function_space)
    u.interpolate(lambda x: 50.0 * np.stack([x[1], 0 * x[1]]))
    assert largest(comm, result.u.x.array - u.x.array) < 1e-10
    assert largest(comm, result.nu.x.array) < 1e-10
    assert np.abs(result.ledger["stored"]).max() < 1e-20 * result.ledger["kinetic_u"][0] + 1e-20
