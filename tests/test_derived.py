# SPDX-License-Identifier: LGPL-3.0-or-later
"""Derived fields against formulas in numpy, cell by cell, in files, Functions and pictures."""

import nonlinear
import numpy as np
import pytest
import ufl
from dolfinx import fem, mesh
from harness import bent, everywhere, refused
from mpi4py import MPI
from written import fields, read, wavy

import complexbody as cb
from complexbody import _compat, picture
from complexbody.action import Action
from complexbody.derived import CELL_FIELDS, NODAL_FIELDS, Derived
from complexbody.errors import BodyError, OutputError
from complexbody.output import Output, Writer
from complexbody.scene import Scene

ETA = np.array([[0.5, 0.1], [0.1, 0.3]])


def body(n, **more):
    """The director with viscosity (in the plane) and an inertia that is a matrix."""
    eta = ETA if n == 2 else 0.7
    return nonlinear.body(n, density=1.3, inertia=np.diag([0.4, 0.9, 0.2][:n]), viscosity=eta)


def by_hand(n, U, nu, N, u_dot, nu_dot):
    """All fields of one cell from gradients, and midpoint values of the rest."""
    F = np.eye(3)
    F[:n] += U
    J, inverse = np.linalg.det(F), np.linalg.inv(F).T
    m = nonlinear.DIRECTION[:n]
    lost = nu - F[:n, :n] @ m
    P = (nonlinear.MU * (F - inverse) + nonlinear.LAM * np.log(J) * inverse)[:n]
    P[:, :n] -= nonlinear.A * np.outer(lost, m)
    z, S = nonlinear.A * lost, nonlinear.B * N
    eta = ETA if n == 2 else 0.7 * np.eye(3)
    omega = np.diag([0.4, 0.9, 0.2][:n])
    return {
        "stress": P,
        "self_action": z,
        "microstress": S,
        "energy_density": nonlinear.by_hand(U, nu, N),
        "cauchy_stress": P @ F.T / J,
        "actual_self_action": z / J,
        "actual_microstress": S @ F.T / J,
        "kinetic_density": 0.65 * u_dot @ u_dot + 0.5 * nu_dot @ omega @ nu_dot,
        "dissipation": nu_dot @ eta @ nu_dot,
    }


def small(x, i):
    """Fields small enough for det F > 0."""
    return 0.1 * wavy(x, i)


@pytest.mark.parametrize("n", [2, 3])
def test_every_cell_by_hand(comm, n):
    """σ = PFᵀ/det F and the others, with gradients of P1 fields taken in numpy."""
    domain = bent(comm, {2: (4, 3), 3: (2, 2, 2)}[n])
    scene = Scene(domain, body(n))
    state = fields(scene, small)
    found = Derived(Action(scene), tuple(CELL_FIELDS)).evaluate(state)
    count = _compat.cell_count(domain)[0]
    for cell, nodes in enumerate(_compat.cell_nodes(domain)[:count]):
        x = domain.geometry.x[nodes]
        at = {name: f.x.array.reshape(-1, n)[nodes] for name, f in state.items()}
        edges = np.linalg.inv((x[1:] - x[0])[:, :n])
        U, N = (np.zeros((n, 3)) for _ in range(2))
        U[:, :n] = (edges @ (at["u"][1:] - at["u"][0])).T
        N[:, :n] = (edges @ (at["nu"][1:] - at["nu"][0])).T
        middle = {name: values.mean(axis=0) for name, values in at.items()}
        expected = by_hand(n, U, middle["nu"], N, middle["u_dot"], middle["nu_dot"])
        assert set(expected) == set(CELL_FIELDS)
        for name, value in expected.items():
            np.testing.assert_allclose(found[name][cell], np.ravel(value), atol=1e-12, err_msg=name)
    # All ranks have cells here, and σ is symmetric only where ν has no moment.
    assert everywhere(comm, count > 0)


def test_stress_of_a_rotated_body(comm):
    """Superposed on a rotation Q, σ, S_e and z_e turn with it: they are seen in space."""
    domain, n = bent(comm, (2, 2, 2)), 3
    scene = Scene(domain, body(n))
    Q, m = cb.rotations.rotation(np.array([0.4, -0.9, 0.5])), nonlinear.DIRECTION

    def state(turn):
        u = lambda x: turn @ (x + 0.1 * np.array([small(x, i) for i in range(3)])) - x  # noqa: E731
        nu = lambda x: turn @ (m[:, None] + np.array([small(x, i + 4) for i in range(3)]))  # noqa: E731
        out = fields(scene, small)
        out["u"].interpolate(u)
        out["nu"].interpolate(nu)
        return out

    names = ("cauchy_stress", "actual_microstress", "actual_self_action", "energy_density")
    derived = Derived(Action(scene), names)
    before, after = derived.evaluate(state(np.eye(3))), derived.evaluate(state(Q))
    sigma = before["cauchy_stress"].reshape(-1, 3, 3)
    np.testing.assert_allclose(
        after["cauchy_stress"].reshape(-1, 3, 3), Q @ sigma @ Q.T, atol=1e-12
    )
    micro = before["actual_microstress"].reshape(-1, 3, 3)
    np.testing.assert_allclose(
        after["actual_microstress"].reshape(-1, 3, 3), Q @ micro @ Q.T, atol=1e-12
    )
    np.testing.assert_allclose(
        after["actual_self_action"], before["actual_self_action"] @ Q.T, atol=1e-12
    )
    np.testing.assert_allclose(after["energy_density"], before["energy_density"], atol=1e-12)


@pytest.fixture(scope="module")
def result(comm):
    """A run that has just begun."""
    scene = Scene(bent(comm, (4, 3)), body(2), initial=nonlinear.spinning(2))
    return cb.simulate(scene, until=0.2)


def test_functions_are_those_of_dolfinx_on_ranks(comm, result):
    """Cell by cell, by the midpoint rule; averages at nodes have the integral of the cells'."""
    square = result.scene.mesh
    names = ("cauchy_stress", "dissipation", "cauchy_stress_at_nodes", "kinetic_density")
    made = cb.derived_fields(result, *names)
    assert tuple(made) == names
    midpoint = ufl.dx(domain=square, metadata={"quadrature_degree": 1})

    def total(density):
        return comm.allreduce(fem.assemble_scalar(_compat.form(density * midpoint)))

    eta, omega = (ufl.as_matrix(m.tolist()) for m in (ETA, np.diag([0.4, 0.9])))
    power = ufl.inner(result.nu_dot, ufl.dot(eta, result.nu_dot))
    kinetic = 0.65 * ufl.inner(result.u_dot, result.u_dot)
    kinetic += 0.5 * ufl.inner(result.nu_dot, ufl.dot(omega, result.nu_dot))
    wrong = (power - made["dissipation"][0]) ** 2 + (kinetic - made["kinetic_density"][0]) ** 2
    F = ufl.variable(ufl.Identity(2) + ufl.grad(result.u))
    J, C = ufl.det(F), ufl.inner(F, F)
    m = ufl.as_vector(nonlinear.DIRECTION[:2].tolist())
    lost = result.nu - ufl.dot(F, m)
    e = 0.5 * nonlinear.MU * C - nonlinear.MU * ufl.ln(J) + 0.5 * nonlinear.LAM * ufl.ln(J) ** 2
    e += 0.5 * nonlinear.A * ufl.inner(lost, lost)
    sigma = ufl.dot(ufl.diff(e, F), F.T) / J
    stored = made["cauchy_stress"]
    wrong += sum((sigma[i, j] - stored[3 * i + j]) ** 2 for i, j in np.ndindex(2, 2))
    assert total(wrong) < 1e-26
    assert comm.allreduce(float(np.abs(made["dissipation"].x.array).max())) > 1e-3
    change = made["cauchy_stress_at_nodes"] - stored
    assert total(sum((2 + i) * change[i] for i in range(6))) == pytest.approx(0, abs=1e-13)
    with refused(OutputError, "'strain'", "cauchy_stress"):
        cb.derived_fields(result, "strain")


def test_pictures(comm, result, shared_path):
    """Cells' and nodes' values are drawn as they are."""
    pytest.importorskip("pyvista")
    made = cb.derived_fields(result, "dissipation", "cauchy_stress_at_nodes")
    panels = [
        picture.Panel("dissipation", warp=None),
        picture.Panel("cauchy_stress_at_nodes", component=0, warp=None),
    ]
    picture.still(shared_path / "fields.png", made, panels)
    comm.barrier()
    assert (shared_path / "fields.png").stat().st_size > 10_000


def test_averages_at_nodes_are_in_files_and_do_not_depend_on_ranks(comm, shared_path):
    """The same numbers as serially, under the symbol of the cells' field."""
    names = ("cauchy_stress_at_nodes", "dissipation_at_nodes", "cauchy_stress")
    names += ("actual_microstress", "actual_self_action")
    for ranks, folder in ((comm, "all"), (MPI.COMM_SELF, f"alone-{comm.rank}")):
        scene = Scene(mesh.create_unit_square(ranks, 4, 3), body(2))
        with Writer(Action(scene), Output(shared_path / folder, fields=names)) as writer:
            writer.write(0.0, fields(scene, small))
    comm.barrier()
    for name in names:
        (_, _, ((_, stored, ours),)), (_, _, ((_, _, alone),)) = (
            read(shared_path / folder / f"{name}.xdmf") for folder in ("all", f"alone-{comm.rank}")
        )
        assert stored == {**CELL_FIELDS, **NODAL_FIELDS}[name]
        np.testing.assert_allclose(ours, alone, rtol=0, atol=1e-13)
        assert np.abs(ours).max() > 1e-3
        center = "Node" if name in NODAL_FIELDS else "Cell"
        assert f'Center="{center}"' in (shared_path / "all" / f"{name}.xdmf").read_text()


def test_actual_fields_need_a_place_in_space(comm):
    """Four components of u have no F."""
    square = mesh.create_unit_square(comm, 2, 2)
    four = cb.Body(1, lambda U, nu, N: ufl.inner(U, U) + nu[0] ** 2, 1.0, 1.0, displacement=4)
    with refused(BodyError, "n_u ≤ 3"):
        Derived(Action(Scene(square, four)), ["cauchy_stress"])
    assert Derived(Action(Scene(square, four)), ["stress"])
