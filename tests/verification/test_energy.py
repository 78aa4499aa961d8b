# SPDX-License-Identifier: LGPL-3.0-or-later
"""The books: energies balance, momenta are kept, dissipation takes, rates vary finitely.

The *discrete* energy (DESIGN §2) balances to round-off for linear forces, whatever acts; the energy
at a step's own time only as well as the scheme is accurate. That it stays bounded and that it does
not drift are two assertions.
"""

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
from busy import INERTIA, LEFT, RIGHT, busy, waves
from dense import Dense, halves, prepared, quadratic, random_hessian, slopes, state
from harness import largest

import complexbody as cb
from complexbody import meshes
from complexbody.forms import isotropic_two_field

SCHEMES = [("exact", 2), ("symmetric", 2), ("forward", 1)]
PAIRS = [
    (kind, scheme)
    for kind in INERTIA
    for scheme, _ in SCHEMES
    if (kind, scheme) != ("no inertia", "symmetric")  # refused: test_oscillator
]

@pytest.mark.parametrize("kind, scheme", PAIRS)
@pytest.mark.parametrize(
    "dim, start",
    [(1, "trapezoidal"), (2, "trapezoidal"), (2, "one-sided"), (3, "trapezoidal")],
)
def test_discrete_energy(comm, dim, kind, scheme, start):
    """The identity holds to round-off after every step, everything included."""
    scene = busy(comm, dim, kind)
    step = prepared(scene, cb.Synchronous(dissipation=scheme)).step
    method = cb.Synchronous(step, dissipation=scheme, start=start)
    ledger = cb.simulate(scene, method, until=50 * step, ledger_steps=1).ledger
    assert abs(ledger["identity"]).max() < 1e-11
    size = ledger["kinetic_u"].max()
    for column in ("work", "support_work", "dissipated", "potential"):
        assert abs(ledger[column]).max() > 1e-4 * size, f"{column} says nothing"


@pytest.mark.parametrize("scheme, order", SCHEMES)
@pytest.mark.parametrize("kind", ["numbers", "blocks"])
def test_balance(comm, kind, scheme, order):
    """The balance at the steps' own times, and its end, converge with the scheme's order."""
    scene, steps, errors = busy(comm, 1, kind), [], []
    for count in (150, 300, 600):
        method = cb.Synchronous(1.0 / count, dissipation=scheme)
        result = cb.simulate(scene, method, until=1.0, ledger_steps=count // 25)
        balance = result.ledger["balance"]
        assert len(balance) == 26
        errors.append([abs(balance).max(), abs(balance[-1])])
        steps.append(result.stats.step)
    measured = slopes(np.array(steps)[:, None], errors)
    # "forward" comes down from 2: its own error is small here.
    assert np.all((order - 0.05 < measured[-1]) & (measured[-1] < 2.2)), measured
    energies = [result.ledger[c] for c in ("kinetic_u", "kinetic_nu", "stored", "potential")]
    assert errors[-1][0] < 2e-3 * abs(np.sum(energies, axis=0)).max()


# --- long runs without dissipation ----------------------------------------------------------------


def quartic(base):
    return lambda U, nu, N: base(U, nu, N) + 2.0 * nu[0] ** 4


@pytest.mark.serial  # long runs of a few cells: only messages would be measured
@pytest.mark.parametrize("nonlinear", [False, True])
def test_no_drift(comm, nonlinear):
    """10⁵ steps: the energy's error stays in its band, and its trend is nothing beside the band."""
    mesh = meshes.jiggled(meshes.interval(comm, 0, 1, 8), 0.2)
    base = quadratic(random_hessian(3, 1, 1, 1), 1)
    body = cb.Body(1, quartic(base) if nonlinear else base, 1.0, 0.7, displacement=1)
    initial = cb.Initial(nu=waves(1, 2), u_dot=waves(1, 4))
    scene = cb.Scene(mesh, body, [cb.Fix("u", LEFT)], initial=initial)
    run = prepared(scene, cb.Synchronous(safety=0.6))
    until = run.step * 1e5
    ledger = cb.simulate(scene, cb.Synchronous(run.step), until=until, ledger_steps=97).ledger
    energy = ledger["kinetic_u"] + ledger["kinetic_nu"] + ledger["stored"]
    assert len(energy) > 1000
    error, time = energy / energy[0] - 1, ledger["time"] / until
    band = abs(error[: len(error) // 10]).max()
    assert 1e-4 < band < 0.2
    assert abs(error).max() < 1.3 * band  # bounded
    trend = np.polyfit(time, error, 1)[0]
    assert abs(trend) < 0.02 * band  # no drift: less than sampling explains
    if not nonlinear:
        assert abs(ledger["identity"]).max() < 1e-11


# --- momenta --------------------------------------------------------------------------------------


def free(comm, dim, loads=()):
    """An unsupported isotropic body of two regions, turning and deforming."""
    bodies = {
        1: isotropic_two_field(d=dim, viscosity=0.6),
        2: isotropic_two_field(d=dim, density=2.0, mu=1.7, k3=0.1, inertia=0.5),
    }
    if dim == 2:
        mesh = meshes.jiggled(meshes.rectangle(comm, (0, 0), (1, 0.8), (6, 5)), 0.2)
    else:
        mesh = meshes.jiggled(meshes.box(comm, (0, 0, 0), (1, 0.8, 0.6), (4, 3, 3)), 0.15)
    given = [waves(dim, seed) for seed in (1, 2, 3, 4)]
    spin = np.array([[0.0, -1.0, 0.3], [1.0, 0.0, -0.5], [-0.3, 0.5, 0.0]])[:dim]
    turning = lambda x: given[2](x) + 0.5 * spin @ x  # noqa: E731
    initial = cb.Initial(given[0], given[1], turning, given[3])
    scene = cb.Scene(mesh, bodies, loads=loads, initial=initial, cell_tags=halves(mesh))
    return scene, list(bodies.values())


@pytest.mark.parametrize("scheme", ["exact", "symmetric", "forward"])
@pytest.mark.parametrize("dim", [2, 3])
def test_momenta_of_a_free_body(comm, dim, scheme):
    """Linear and angular momentum stay to round-off, with dissipation of ν as well."""
    scene, bodies = free(comm, dim)
    method = cb.Synchronous(dissipation=scheme)
    ledger = cb.simulate(scene, method, until=3.0, ledger_steps=7).ledger
    momentum = np.stack([ledger[f"momentum_{i + 1}"] for i in range(dim)])
    speed = np.sqrt(2 * ledger["kinetic_u"].max())
    assert abs(momentum[:, 0]).max() > 1e-2 * speed
    assert abs(momentum - momentum[:, :1]).max() < 1e-12 * speed
    dense, run = Dense(scene.mesh, bodies), prepared(scene, method)

    def angular():
        v = state(run)[1][:, :dim]
        mass = dense.M[:, 0, 0]
        pairs = [(0, 1), (0, 2), (1, 2)][: dim * (dim - 1) // 2]
        x = dense.points
        return np.array([mass @ (x[:, i] * v[:, j] - x[:, j] * v[:, i]) for i, j in pairs])

    first = angular()
    assert abs(first).max() > 1e-2 * speed
    for _ in range(5):
        run.advance(10)
        assert abs(angular() - first).max() < 1e-12 * speed


def test_impulse(comm):
    """Momentum gained is the trapezoidal sum of the loads to round-off, their integral to O(h²)."""
    history, pull, weight = cb.ricker(0.9), np.array([0.3, -0.2]), np.array([0.0, -0.5])
    loads = [cb.Traction(RIGHT, pull, history), cb.BodyForce(weight)]
    scene, _ = free(comm, 2, loads)
    steps, errors = [], []
    for count in (80, 160):
        ledger = cb.simulate(scene, cb.Synchronous(2.0 / count), until=2.0, ledger_steps=1).ledger
        t = ledger["time"]
        factors = history(t)
        summed = np.concatenate([[0], np.cumsum((factors[1:] + factors[:-1]) / 2)]) * 2.0 / count
        for i in range(2):
            momentum = ledger[f"momentum_{i + 1}"]
            # The loaded side is 0.8 long, the area is 0.8.
            gained = 0.8 * pull[i] * summed + 0.8 * weight[i] * t
            assert abs(momentum - momentum[0] - gained).max() < 1e-12
        exact, _ = scipy.integrate.quad(history, 0, 0.7, epsabs=1e-13, epsrel=1e-13)
        at = np.argmin(abs(t - 0.7))
        errors.append(abs(0.8 * pull[0] * (summed[at] - exact)))
        steps.append(2.0 / count)
    assert abs(slopes(steps, errors)[0] - 2) < 0.05


# --- dissipation and variation --------------------------------------------------------------------


@pytest.mark.parametrize("kind, scheme", PAIRS)
def test_dissipation_takes(comm, kind, scheme):
    """What is dissipated never falls, and without loads it is what the energy loses."""
    mesh = meshes.jiggled(meshes.interval(comm, 0, 1, 14), 0.2)
    inertia, viscosity = INERTIA[kind][0]
    base = quadratic(random_hessian(4, 1, 2, 1), 1)
    body = cb.Body(2, base, 1.0, inertia, viscosity, displacement=1)
    initial = cb.Initial(waves(1, 2), waves(2, 3), waves(1, 4), waves(2, 5))
    supports = [cb.Fix("u", LEFT), cb.Fix("nu", LEFT)]
    scene = cb.Scene(mesh, body, supports, initial=initial)
    step = prepared(scene, cb.Synchronous(dissipation=scheme)).step / 5
    method = cb.Synchronous(step, dissipation=scheme)
    ledger = cb.simulate(scene, method, until=2.0, ledger_steps=3).ledger
    lost = ledger["dissipated"]
    assert lost[0] == 0.0 and np.all(np.diff(lost) >= 0)
    energy = ledger["kinetic_u"] + ledger["kinetic_nu"] + ledger["stored"]
    assert lost[-1] > 0.1 * energy[0]
    assert energy[-1] + lost[-1] == pytest.approx(energy[0], rel=0.1)


def test_variation_of_rates(comm):
    """Proposition 1: pV of u̇ and ν̇ tends to ∫∫|q̈| as h → 0, bounded by it, with order 1."""
    A, K, R, k0, eta, cells, until = 1.0, 0.6, 0.3, 0.5, 0.8, 12, 2.0

    def energy(U, nu, N):
        squares = A * U[0, 0] ** 2 + K * N[0, 0] ** 2 + k0 * nu[0] ** 2
        return 0.5 * squares + R * U[0, 0] * N[0, 0]

    def sine(x):
        return np.sin(np.pi * x[:1])

    body = cb.Body(1, energy, 1.0, 1.0, eta, displacement=1)
    mesh = meshes.interval(comm, 0, 1, cells)
    supports = [cb.Fix("u", "boundary"), cb.Fix("nu", "boundary")]
    initial = cb.Initial(sine, lambda x: -0.5 * sine(x))
    scene = cb.Scene(mesh, body, supports, initial=initial, self_action="lumped")
    Q = 4 * cells**2 * np.sin(np.pi / (2 * cells)) ** 2
    S = np.zeros((4, 4))
    S[0, 2] = S[1, 3] = 1.0
    S[2:, :2], S[3, 3] = [[-A * Q, -R * Q], [-R * Q, -K * Q - k0]], -eta
    t = np.linspace(0, until, 20001)
    jump = scipy.linalg.expm(S * t[1])
    y = [np.array([1.0, -0.5, 0.0, 0.0])]
    for _ in t[1:]:
        y.append(jump @ y[-1])
    acceleration = abs(np.array(y) @ S.T)[:, 2:]
    shape = np.sin(np.pi * np.arange(cells + 1) / cells).sum() / cells
    exact = shape * scipy.integrate.simpson(acceleration, x=t, axis=0)
    steps, errors = [], []
    for count in (100, 200, 400, 800):
        ledger = cb.simulate(scene, cb.Synchronous(until / count), until=until).ledger
        found = np.array([ledger["variation_u"][-1], ledger["variation_nu"][-1]])
        assert np.all(np.diff(ledger["variation_u"]) >= 0)
        assert np.all(found < 1.01 * exact), "not bounded by the limit"
        steps.append(until / count)
        errors.append(abs(found - exact).max())
    measured = slopes(steps, errors)
    assert np.all(measured > 0.9), measured


# --- no false alarm -------------------------------------------------------------------------------

SOFT = quadratic(random_hessian(4, 1, 1, 1), 1)
QUIET = {
    "load that rises": dict(loads=[cb.Traction(RIGHT, 1.0, cb.ramp(1.0))]),
    "load that comes later": dict(loads=[cb.BodyForce(1.0, cb.step(0.31))]),
    "load on nu": dict(loads=[cb.BodyForce(1.0, cb.sine(0.5), field="nu")]),
    "support that moves later": dict(
        supports=[cb.Fix("u", LEFT, 0.2, history=cb.ramp(0.4, 0.3)), cb.Fix("nu", LEFT)]
    ),
    "support of nu that moves": dict(
        supports=[cb.Fix("u", LEFT), cb.Fix("nu", LEFT, 0.2, history=cb.ramp(0.7))]
    ),
    "potential": dict(potential=lambda u, nu: -0.2 * u[0]),
    "prestress": dict(energy=lambda U, nu, N: SOFT(U, nu, N) + 0.1 * U[0, 0]),
    "stiff damping": dict(viscosity=1e4, initial=cb.Initial(nu_dot=waves(1, 1))),
    "no inertia": dict(inertia=0.0, viscosity=3.0, loads=[cb.BodyForce(1.0, field="nu")]),
}


@pytest.mark.serial  # what is booked is the same on all ranks: test_ranks
@pytest.mark.parametrize("start", ["trapezoidal", "one-sided"])
@pytest.mark.parametrize(
    "case, scheme",
    [
        (case, scheme)
        for case in QUIET
        for scheme, _ in SCHEMES
        if (case, scheme) != ("no inertia", "symmetric")
    ],
)
def test_rest_is_no_divergence(comm, case, start, scheme):
    """Whatever ends the rest of a body, a stable run is not stopped, however often it is booked."""
    given = dict(QUIET[case])
    names = ("energy", "inertia", "viscosity", "potential")
    body = {"energy": SOFT, "inertia": 0.8} | {n: given.pop(n) for n in names if n in given}
    given = {"supports": [cb.Fix("u", LEFT), cb.Fix("nu", LEFT)]} | given
    mesh = meshes.jiggled(meshes.interval(comm, 0, 1, 14), 0.2)
    scene = cb.Scene(mesh, cb.Body(1, density=1.0, displacement=1, **body), **given)
    method = cb.Synchronous(dissipation=scheme, start=start)
    result = cb.simulate(scene, method, until=0.8, ledger_steps=1)
    moved = largest(comm, result.u.x.array), largest(comm, result.nu.x.array)
    assert max(moved) > (1e-6 if case == "stiff damping" else 1e-2)


def test_balanced_from_the_first_step(comm):
    """From rest, kinetic energy after the first kicks is the loads' work, not a surprise."""
    mesh = meshes.interval(comm, 0, 1, 10)
    body = cb.Body(1, SOFT, 1.0, 0.8, displacement=1)
    scene = cb.Scene(mesh, body, loads=[cb.BodyForce(1.0, cb.ramp(1.0))])
    ledger = cb.simulate(scene, cb.Synchronous(), until=1.0, ledger_steps=1).ledger
    assert ledger["kinetic_u"][1] > 0
    assert abs(ledger["balance"][1]) < 1e-12 * ledger["kinetic_u"][1]
