# SPDX-License-Identifier: LGPL-3.0-or-later
"""Absorbing boundaries: impedances, what comes back, books, stability, ranks, what is refused."""

import dolfinx
import numpy as np
import pytest
import scipy.linalg
import ufl
from harness import bent, refused, wavy
from mpi4py import MPI

import complexbody as cb
from complexbody.errors import IntegratorError, SceneError
from complexbody.forms import isotropic_two_field
from complexbody.impedance import impedance
from complexbody.problem import Problem
from complexbody.spectrum import largest_eigenvalue

COMM = MPI.COMM_WORLD
X = np.array([1.0, 0.0, 0.0])


def bar():
    """P and S waves of u, P coupled to ν: four moduli, two components of u and one of ν."""

    def energy(U, nu, N):
        return 2 * U[0, 0] ** 2 + 0.5 * U[1, 0] ** 2 + N[0, 0] ** 2 + 0.9 * U[0, 0] * N[0, 0]

    return cb.Body(1, energy, 1.0, 0.7, displacement=2)


# --- impedances ------------------------------------------------------------------------------


def test_impedance_is_the_geometric_mean():
    """Z M⁻¹ Z = A, for any coupling."""
    rng, n = np.random.default_rng(1), 4
    B, C = rng.normal(size=(4 * n, 4 * n)), rng.normal(size=(n, n))
    H, M, D = B @ B.T, C @ C.T + np.eye(n), np.zeros((n, n))
    normal = np.array([1.0, 2.0, 2.0]) / 3
    Z, N = impedance(H, M, D, normal), np.kron(np.eye(n), normal[:, None])
    A = N.T @ H[: 3 * n, : 3 * n] @ N
    assert np.abs(Z @ np.linalg.solve(M, Z) - A).max() < 1e-12 * np.abs(A).max()
    assert np.abs(Z - Z.T).max() == 0 and np.linalg.eigvalsh(Z).min() > 0
    # The limit of high frequencies, whatever C, G and D: the error falls like 1/ω.
    errors = [np.abs(impedance(H, M, np.diag([0, 0, 1, 2.0]), normal, f) - Z).max()
              for f in (30.0, 300.0)]  # fmt: skip
    assert errors[1] < 0.11 * errors[0] < 0.01


def test_impedance_of_isotropic_bodies():
    """ρc_P n⊗n + ρc_S (I − n⊗n) in any direction; nothing couples u and ν without k3."""
    body = isotropic_two_field(k3=0.0, k3_sym=0.0)
    mesh = dolfinx.mesh.create_unit_cube(MPI.COMM_SELF, 1, 1, 1)
    H = Problem(cb.Scene(mesh, body)).hessian_samples(0)[0]
    n = np.array([2.0, -1.0, 2.0]) / 3
    Z = impedance(H, np.eye(6), np.zeros((6, 6)), n)
    P, S = np.outer(n, n), np.eye(3) - np.outer(n, n)
    assert np.abs(Z[:3, :3] - np.sqrt(3.0) * P - S).max() < 1e-14
    assert np.abs(Z[3:, 3:] - np.sqrt(1.5) * P - np.sqrt(0.75) * S).max() < 1e-14
    assert np.all(Z[:3, 3:] == 0)


def test_impedance_at_a_frequency():
    H, M, D = np.zeros((8, 8)), np.diag([1.0, 2.0]), np.zeros((2, 2))
    H[0, 0], H[3, 3], H[7, 7] = 4.0, 3.0, 5.0
    omega = 2 * np.pi
    Z = impedance(H, M, D, X, 1.0)
    assert Z == pytest.approx(np.diag([2.0, np.sqrt(3 * (2 - 5 / omega**2))]), abs=1e-7)
    # Below its cut-off ν carries no energy.
    assert impedance(H, M, D, X, 0.2)[1, 1] < 1e-6
    # ν without gradients, driven by ε as in a body with voids: u feels A − b²/(ξ − ω²ρ̄).
    H[3, 3], H[0, 7], H[7, 0] = 0.0, 1.0, 1.0
    Z = impedance(H, M, D, X, 1.0)
    assert Z == pytest.approx(np.diag([np.sqrt(4 - 1 / (5 - 2 * omega**2)), 0.0]), abs=1e-7)


# --- what comes back -------------------------------------------------------------------------


def left_over(method, kind, absorb, cells=120):
    """Share of the energy of a pulse that is in the bar once it should have left it."""
    mesh = dolfinx.mesh.create_interval(COMM, cells, [0.0, 1.0])

    def pulse(x):
        return np.exp(-(((x[0] - 0.5) / 0.06) ** 2))

    amount = dict(P=(1, 0, 0), S=(0, 1, 0), nu=(0, 0, 1), all=(1, -1, 0.5))[kind]
    initial = cb.Initial(
        u=lambda x: np.outer(amount[:2], pulse(x)), nu=lambda x: amount[2] * pulse(x)[None]
    )
    ends = [cb.Absorb("boundary")] if absorb else ()
    scene = cb.Scene(mesh, bar(), initial=initial, absorbing=ends)
    books = cb.simulate(scene, method, until=1.2, progress=False).ledger
    energy = sum(books[name] for name in ("kinetic_u", "kinetic_nu", "stored"))
    given = np.abs(books["dissipated"][-1] + energy[-1] - energy[0]) / energy[0]
    return energy[-1] / energy[0], given, np.abs(books["identity"]).max()


@pytest.mark.parametrize("kind", ["P", "S", "nu", "all"])
def test_waves_of_all_kinds_leave(kind):
    assert left_over(cb.Synchronous(), kind, absorb=False)[0] > 0.99
    left, missing, identity = left_over(cb.Synchronous(), kind, absorb=True)
    assert left < 1e-4 and missing < 0.02 and identity < 1e-11


@pytest.mark.parametrize(
    "method",
    [cb.Synchronous(dissipation="symmetric"), cb.Synchronous(dissipation="forward"), cb.AVI(),
     cb.AVI(balanced=False), cb.AVI(schedule="exact"), cb.AVI.as_published(), cb.LocalLeapfrog(),
     cb.Implicit(), cb.Newmark(step=2e-3), cb.AssembledLeapfrog(),
     cb.PetscTS("rk4", step=1e-3)],
    ids=lambda m: "-".join(str(getattr(m, a, "")) for a in ("__class__", "schedule", "order")),
)  # fmt: skip
def test_waves_leave_with_every_integrator_on_all_ranks(method):
    left, missing, identity = left_over(method, "all", absorb=True)
    assert left < 1e-4 and missing < 0.03 and identity < 1e-11


@pytest.mark.serial
def test_a_given_frequency_is_matched():
    """A wave above the cut-off of a self-action leaves a bar that is matched to it."""
    k0, f = 400.0, 4.0  # cut-off 20/2π = 3.2 Hz
    body = cb.Body(1, lambda U, v, N: U[0, 0] ** 2 + 0.5 * N[0, 0] ** 2 + 0.5 * k0 * v[0] ** 2,
                   1.0, 1.0, displacement=1)  # fmt: skip

    def reflected(frequency):
        length, cells = 6.0, 480
        mesh = dolfinx.mesh.create_interval(MPI.COMM_SELF, cells, [0.0, length])
        omega = 2 * np.pi * f
        q = np.sqrt(omega**2 - k0)
        speed, width = q / omega, 0.7

        def packet(x, rate):
            s = x[0] - 3.0
            g = np.exp(-((s / width) ** 2))
            # f(s, t) = g(s − ct) cos(qs − ωt), to leading order in the width.
            d = g * omega * np.sin(q * s) + 2 * s / width**2 * speed * g * np.cos(q * s)
            return (d if rate else g * np.cos(q * s))[None]

        initial = cb.Initial(nu=lambda x: packet(x, False), nu_dot=lambda x: packet(x, True))
        end = cb.Absorb(lambda x: x[0] > length - 1e-9, frequency)
        scene = cb.Scene(mesh, body, initial=initial, absorbing=[end])
        books = cb.simulate(scene, until=length / speed, progress=False).ledger
        energy = books["kinetic_nu"] + books["stored"]
        return energy[-1] / energy[0]

    assert reflected(f) < 0.5 * reflected(None)


# --- a plain reference -----------------------------------------------------------------------


@pytest.mark.serial
@pytest.mark.parametrize("scheme", ["exact", "symmetric", "forward"])
def test_trajectories_are_those_of_plain_matrices(scheme):
    """(M̂ + hD/2)v⁺ = (M̂ − hD/2)v⁻ + hf, with D of an independent square root; viscous ν."""
    cells, length, eta = 9, 1.0, 0.8
    mesh = dolfinx.mesh.create_interval(MPI.COMM_SELF, cells, [0.0, length])
    body = bar()
    body = cb.Body(1, body.energy, 1.0, 0.7, viscosity=eta, displacement=2)
    h, n, dx = 0.02, 3, length / cells
    nodes = np.arange(cells + 1)
    A = np.array([[4.0, 0.0, 0.9], [0.0, 1.0, 0.0], [0.9, 0.0, 2.0]])
    M1, E1 = np.diag([1.0, 1.0, 0.7]), np.diag([0.0, 0.0, eta])
    root = scipy.linalg.sqrtm(M1).real
    Z = root @ scipy.linalg.sqrtm(np.linalg.inv(root) @ A @ np.linalg.inv(root)).real @ root
    size = n * (cells + 1)
    K, M, D = (np.zeros((size, size)) for _ in range(3))
    s = 0.5 * h * eta / 0.7
    factor = {"symmetric": 1.0, "forward": 1 + s, "exact": s / np.tanh(s)}[scheme]
    mean = np.diag([1.0, 1.0, 0.7 * factor])
    for i in range(cells):
        a, b = slice(n * i, n * i + n), slice(n * i + n, n * i + 2 * n)
        for p, q, sign in ((a, a, 1), (b, b, 1), (a, b, -1), (b, a, -1)):
            K[p, q] += sign * A / dx
        for p in (a, b):
            M[p, p] += 0.5 * dx * mean
            D[p, p] += 0.5 * dx * E1
    D[:n, :n] += Z
    D[-n:, -n:] += Z
    x = mesh.geometry.x[:, 0]
    values = wavy(mesh, n, seed=3)
    order = np.argsort(x)
    scene = cb.Scene(
        mesh, body, absorbing=[cb.Absorb("boundary")],
        initial=cb.Initial(u=lambda y: values[:, :2].T, nu=lambda y: values[:, 2:].T),
    )  # fmt: skip
    result = cb.simulate(
        scene, cb.Synchronous(step=h, dissipation=scheme), until=1.0, progress=False, ledger_steps=5
    )
    q, v = values[order].ravel(), np.zeros(size)
    plus, minus = M + 0.5 * h * D, M - 0.5 * h * D
    for step in range(round(1.0 / h)):
        f = -K @ q
        v = np.linalg.solve(plus, minus @ v + (0.5 if step == 0 else 1.0) * h * f)
        q = q + h * v
    found = np.column_stack([result.u.x.array.reshape(-1, 2), result.nu.x.array])[order].ravel()
    assert len(nodes) == len(order)
    assert np.abs(found - q).max() < 1e-12 * np.abs(values).max()
    assert np.abs(result.ledger["identity"]).max() < 1e-11


# --- books, stability, ranks -----------------------------------------------------------------


def room(comm, cells=(5, 4), dim=2, viscosity=0.0):
    mesh = bent(comm, cells)
    return mesh, isotropic_two_field(d=dim, viscosity=viscosity)


@pytest.mark.parametrize("dissipation", ["exact", "symmetric", "forward"])
@pytest.mark.parametrize("cells", [(5, 4), (3, 3, 2)])
def test_discrete_energy_balances_to_round_off(cells, dissipation):
    mesh, body = room(COMM, cells, len(cells), viscosity=0.5)
    d = len(cells)
    values = wavy(mesh, 2 * d)
    initial = cb.Initial(u=lambda x: values[:, :d].T, nu_dot=lambda x: values[:, d:].T)
    scene = cb.Scene(
        mesh, body, initial=initial, absorbing=[cb.Absorb("boundary")],
        loads=[cb.PointSource([0.4] * d, np.ones(d), cb.ricker(2.0))],
    )  # fmt: skip
    ledger = cb.simulate(
        scene, cb.Synchronous(dissipation=dissipation), until=1.0, progress=False, ledger_steps=1
    ).ledger
    assert np.abs(ledger["identity"]).max() < 1e-11
    assert np.all(np.diff(ledger["dissipated"]) > 0)


@pytest.mark.serial
@pytest.mark.parametrize("scheme", ["exact", "symmetric", "forward"])
def test_dampers_change_no_critical_step(scheme):
    mesh, body = room(MPI.COMM_SELF, viscosity=0.5)
    bound, values = [], []
    for absorbing in ((), [cb.Absorb("boundary")]):
        problem = Problem(cb.Scene(mesh, body, absorbing=absorbing))
        bound.append(cb.Synchronous(dissipation=scheme).prepare(problem, 1.0).critical)
        values.append(largest_eigenvalue(problem, bound[0], scheme))
    assert bound[0] == bound[1]
    assert values[0] == pytest.approx(values[1], rel=1e-9)
    # Just below what SLEPc says is stable, just above it is not.
    limit = cb.Synchronous(dissipation=scheme, critical="global").prepare(problem, 1.0).critical
    start = wavy(mesh, 4)
    for factor, grows in ((0.999, False), (1.02, True)):
        initial = cb.Initial(u=lambda x: start[:, :2].T, nu=lambda x: start[:, 2:].T)
        scene = cb.Scene(mesh, body, initial=initial, absorbing=[cb.Absorb("boundary")])
        method = cb.Synchronous(step=factor * limit, dissipation=scheme, unstable_ok=True)
        books = cb.simulate(scene, method, until=800 * limit, growth=None, progress=False).ledger
        assert (books["stored"][-1] > books["stored"][0]) == grows


@pytest.mark.parametrize("method", [cb.AVI(), cb.LocalLeapfrog()], ids=["AVI", "LocalLeapfrog"])
def test_uneven_cells_stay_stable_on_all_ranks(method):
    """Balanced windows grow at dampers (1e3 by here) unless the cells there blend their forces."""
    rng = np.random.default_rng(3)
    mesh = dolfinx.mesh.create_interval(COMM, 30, [0.0, 1.0])
    knots = np.concatenate([[0], np.cumsum(rng.uniform(1, 3, 30))])
    x = mesh.geometry.x
    x[:, 0] = np.interp(x[:, 0], np.linspace(0, 1, 31), knots / knots[-1])
    values = wavy(mesh, 3)
    initial = cb.Initial(u_dot=lambda x: values[:, :2].T, nu_dot=lambda x: values[:, 2:].T)
    held = [cb.Fix(f, where=lambda x: x[0] < 1e-9) for f in ("u", "nu")]
    scene = cb.Scene(
        mesh, bar(), supports=held, initial=initial,
        absorbing=[cb.Absorb(where=lambda x: x[0] > 1 - 1e-9)],
    )  # fmt: skip
    books = cb.simulate(scene, method, until=20.0, growth=None, progress=False).ledger
    energy = sum(books[name] for name in ("kinetic_u", "kinetic_nu", "stored"))
    assert energy[-1] < 0.6 * energy[0]


def state(mesh, method, plan=True):
    body = isotropic_two_field(d=2, viscosity=0.2)

    def start(x):
        g = np.exp(-((x[0] - 0.5) ** 2 + (x[1] - 0.4) ** 2) / 0.02)
        return np.array([g, 0.5 * g])

    absorbing = [
        cb.Absorb(lambda x: x[0] > 0.9),
        cb.Absorb(lambda x: (x[1] < 0.1) & (x[0] < 0.8), field="u"),
    ]
    scene = cb.Scene(mesh, body, initial=cb.Initial(u_dot=start), absorbing=absorbing)
    result = cb.simulate(scene, method, until=0.6, progress=False, plan=plan)
    values = np.column_stack([f.x.array.reshape(-1, 2) for f in (result.u, result.nu_dot)])
    mine = {tuple(np.round(p, 8)): v for p, v in zip(mesh.geometry.x, values, strict=True)}
    return {k: v for part in mesh.comm.allgather(mine) for k, v in part.items()}


@pytest.mark.parametrize(
    "method", [cb.Synchronous(), cb.AVI(), cb.LocalLeapfrog()], ids=lambda m: type(m).__name__
)
def test_ranks_agree(method):
    mesh = bent(COMM, (9, 8))
    alone, here = state(bent(MPI.COMM_SELF, (9, 8)), method), state(mesh, method)
    assert alone.keys() == here.keys()
    size = max(np.abs(v).max() for v in alone.values())
    assert max(np.abs(alone[k] - v).max() for k, v in here.items()) < 1e-11 * size


def test_components_left_out_change_nothing():
    """Antiplane motion in a body of three components: one is live, on an oblique boundary too."""
    mesh = bent(COMM, (6, 5))
    body = isotropic_two_field(k3=0.0, k3_sym=0.0)
    found = []
    for plan in (True, False):
        def start(x):
            return np.array([0 * x[0], 0 * x[0], np.cos(3 * x[0] + x[1])])

        scene = cb.Scene(mesh, body, initial=cb.Initial(u=start), absorbing=[cb.Absorb("boundary")])
        found.append(cb.simulate(scene, until=0.8, progress=False, plan=plan).u.x.array.copy())
    assert np.abs(found[0] - found[1]).max(initial=0.0) < 1e-13


# --- energies that are not quadratic ---------------------------------------------------------


def hardening(quartic):
    """e = U²/2 + q(U⁴ + (UN)²)/4 + N² + UN/2 of a bar, and its Hessian at a state."""

    def energy(U, nu, N):
        U, N = U[0, 0], N[0, 0]
        return 0.5 * U**2 + quartic * (U**4 + (U * N) ** 2) / 4 + N**2 + 0.5 * U * N

    def second(U, N):
        off = 0.5 + quartic * U * N
        return np.array([[1 + quartic * (3 * U**2 + N**2 / 2), off], [off, 2 + quartic * U**2 / 2]])

    return cb.Body(1, energy, 1.3, 0.7, displacement=1), second


@pytest.mark.serial
def test_small_waves_about_the_start_are_matched():
    """The impedance is the geometric mean of masses and the Hessian at the initial gradients."""
    mesh, (body, second) = dolfinx.mesh.create_interval(MPI.COMM_SELF, 7, [0.0, 1.0]), hardening(4)
    start = cb.Initial(u=lambda x: 0.3 * x[0], nu=lambda x: 1 - 0.2 * x[0])
    problem = Problem(cb.Scene(mesh, body, initial=start, absorbing=[cb.Absorb("boundary")]))
    M = np.diag([1.3, 0.7])
    root = np.sqrt(M)
    back = np.linalg.inv(root)
    Z = root @ scipy.linalg.sqrtm(back @ second(0.3, -0.2) @ back) @ root
    assert problem.dampers is not None
    np.testing.assert_allclose(problem.dampers.matrix, [Z, Z], rtol=1e-9)
    problem.close()


@pytest.mark.parametrize("method", [cb.Synchronous(), cb.AVI(), cb.AVI(schedule="exact")])
def test_pulses_of_a_nonlinear_bar_leave(method):
    """Small ones as in a linear bar; of large ones some part comes back."""
    mesh, (body, _) = dolfinx.mesh.create_interval(COMM, 300, [0.0, 1.0]), hardening(4.0)
    left = []
    for size in (1e-3, 0.04):
        start = cb.Initial(u=lambda x, s=size: s * np.exp(-(((x[0] - 0.5) / 0.06) ** 2)))
        scene = cb.Scene(mesh, body, initial=start, absorbing=[cb.Absorb("boundary")])
        books = cb.simulate(scene, method, until=2.0, progress=False).ledger
        energy = sum(books[name] for name in ("kinetic_u", "kinetic_nu", "stored"))
        left.append(energy[-1] / energy[0])
    assert left[0] < 1e-4 < left[1] < 0.2


# --- refusals --------------------------------------------------------------------------------


def test_what_cannot_absorb_is_refused_on_all_ranks():
    mesh, body = room(COMM)

    def run(absorbing, method=None, body=body):
        cb.simulate(cb.Scene(mesh, body, absorbing=absorbing), method, until=0.1, progress=False)

    with refused(SceneError, "selects no boundary facet"):
        run(cb.Absorb(lambda x: x[0] > 9))
    with refused(SceneError, "another Absorb"):
        run([cb.Absorb("boundary"), cb.Absorb(lambda x: x[0] > 0.5)])
    with refused(SceneError, "frequency"):
        run(cb.Absorb("boundary", frequency=-1.0))
    with refused(SceneError, "'u' or 'nu'"):
        run(cb.Absorb("boundary", field="w"))
    with refused(SceneError, "does not belong"):
        run([cb.Fix("u", "boundary")])
    with refused(SceneError, "tag"):
        run(cb.Absorb(7))
    with refused(IntegratorError, "Implicit", "Synchronous"):
        run(cb.Absorb("boundary"), cb.Implicit(forces="implicit"))
    lazy = cb.Body(1, lambda U, v, N: ufl.inner(U, U) + ufl.inner(N, N), 1.0, 0.0, viscosity=1.0)
    with refused(SceneError, "no inertia"):
        run(cb.Absorb("boundary"), body=lazy)
    run(cb.Absorb("boundary", field=None, frequency=2.0), body=lazy)


@pytest.mark.serial
def test_waves_that_cannot_be_told_are_refused():
    """A second derivative at the start that varies within cells."""
    mesh = dolfinx.mesh.create_interval(MPI.COMM_SELF, 3, [0.0, 1.0])
    x = ufl.SpatialCoordinate(mesh)
    body = cb.Body(1, lambda U, v, N: (1 + x[0]) * U[0, 0] ** 2 + N[0, 0] ** 2, 1.0, 1.0,
                   displacement=1)  # fmt: skip
    with refused(SceneError, "varies within cells"):
        Problem(cb.Scene(mesh, body, absorbing=[cb.Absorb("boundary")]))
