# SPDX-License-Identifier: LGPL-3.0-or-later
"""Rates of asynchronous windows: their variation (the paper's Proposition 1), momenta, energies."""

import numpy as np
import pytest
import scipy.linalg
from dense import prepared, quadratic, random_hessian, slopes, state
from mpi4py import MPI
from verification.cases import CASES, ETA, OMEGA, SCHEMES, Case, build, graded, reference, wave
from verification.waves import semidiscrete

import complexbody as cb

BALANCED = pytest.mark.parametrize("balanced", [False, True], ids=["plain", "balanced"])

# --- variation -----------------------------------------------------------------------------------


def variation(plain):
    """pV of the logged rates of u and ν: Σ V_a |v⁺ − v⁻|₁ between a node's intervals."""
    out, before = np.zeros(plain.n), {}
    for a, _, _, _, rate in plain.log:
        if a in before:
            out += plain.volume[a] * abs(rate - before[a])
        before[a] = rate
    return out


def bounds(plain, until):
    """What pV lies between for T_Θ → 0: ∫ |q̈| of the solution, and all that acts, each by itself.

    A node's rate changes by what each of its cells gives, together or apart, and by damping.
    """
    solve, nodes = semidiscrete(plain), range(plain.size)
    times = (np.arange(400) + 0.5) * until / 400
    least, most = np.zeros((2, plain.n))
    for t in times:
        q, v = solve(t)
        forces = [p.force(q[c]) for c, p in zip(plain.cells, plain.potentials, strict=True)]
        # Balanced forces act together all the time; kicks come one by one.
        parts = [f if plain.balanced else abs(f) for f in forces]
        force, load = plain._assemble(forces), plain.load(t)
        apart = plain._assemble(parts)
        apart = abs(apart + load) if plain.balanced else apart + abs(load)
        for a in nodes:
            m, d = (np.diag(getattr(plain.nodes[a], name)) for name in "MD")
            ix = plain.free[a]
            weight = plain.volume[a] / m * until / len(times)
            least[ix] += weight * abs((force + load)[a, ix] - d * v[a, ix])
            most[ix] += weight * (apart[a, ix] + d * abs(v[a, ix]))
    return least, most


@pytest.mark.serial
@BALANCED
@pytest.mark.parametrize("scheme", SCHEMES)
def test_variation_of_rates(scheme, balanced):
    """Proposition 1: pV of u̇ and of ν̇ is bounded as T_Θ → 0 on one mesh, τ_Θ bounded.

    The bound is what acts on the nodes, from the solution alone: it knows no step.
    """
    case = Case(1, 1, 1, (0.8,), (1.7,), potential=True)
    mesh, until, found = graded(MPI.COMM_SELF, 1, 6, seed=4), 0.7, []
    for safety in (0.4, 0.2, 0.1, 0.05):
        method = cb.AVI(safety, balanced=balanced, dissipation=scheme)
        run = prepared(build(MPI.COMM_SELF, case, mesh), method, until)
        plain = reference(run, case)
        assert 2 <= run.time_sets.asynchronicity < 10
        least, most = bounds(plain, until)
        plain.log, windows = [], round(until / run.step)
        run.advance(windows)
        plain.advance(windows)
        assert abs(state(run)[0] - plain.q).max() < 1e-10
        found.append(variation(plain))
    found = np.array(found)
    assert np.all(found <= most), (found, most)
    assert np.all(found[-1] >= 0.95 * least), (found, least)
    # It settles: another half of the step changes less and less.
    settled = 0.05 if scheme == "forward" else 0.03  # first order
    assert np.all(abs(found[-1] - found[-2]) < settled * found[-1]), found


# --- momenta -------------------------------------------------------------------------------------

DAMPED = {"numbers": (0.8, 1.7), "matrices": (OMEGA, ETA)}


def free_body(comm, kind, own):
    """A free body whose energy sees ∇u and ∇ν, and ν itself by ½ own |ν|² only."""
    omega, eta = DAMPED[kind]
    H = random_hessian(3, 2, 2, 2)
    H[8:], H[:, 8:] = 0.0, 0.0
    H[8:, 8:] = own * np.eye(2)
    mesh = graded(comm, 2, (6, 4))
    body = cb.Body(2, quadratic(H, 2), 1.3, omega, eta, displacement=2)
    waves = [wave(2, seed) for seed in range(4)]
    waves[3] = lambda x, part=waves[3]: part(x) + np.array([[1.0], [-0.6]])
    initial = cb.Initial(*waves)
    return cb.Scene(mesh, body, initial=initial)


def totals(run):
    """Sums over the body of mass · rate (u, then ν), of volume · ν, and of |mass · rate|."""
    disc, masses = run.problem.disc, run.problem.masses
    M = masses.full(masses.inertia, masses.density)[masses.classes[:-1]]
    fields, rates = (values[:-1, : disc.n] for values in run.sample())
    weight = disc.volume * disc.owned
    momenta = np.einsum("aij,aj->ai", M, rates)
    sums = [weight @ momenta, weight @ fields[:, 2:], weight @ abs(momenta)]
    return [disc.comm.allreduce(part) for part in sums]


def decayed(kind, own, momentum, position, t):
    """(Σ Ων̇, Σ ν) at t: forces between nodes cancel, so the sums are one damped oscillator."""
    omega, eta = (value * np.eye(2) if np.ndim(value) == 0 else value for value in DAMPED[kind])
    inverse = np.linalg.inv(omega)
    rates = np.block([[-eta @ inverse, -own * np.eye(2)], [inverse, np.zeros((2, 2))]])
    return np.split(scipy.linalg.expm(t * rates) @ np.concatenate([momentum, position]), 2)


@BALANCED
@pytest.mark.parametrize("own", [0.0, 0.9], ids=["free", "held"])
@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("kind", DAMPED)
def test_momenta(comm, kind, scheme, own, balanced):
    """u keeps its momentum; that of ν decays as the solution's, with "exact" to round-off."""
    until, errors, steps = 0.8, [], []
    for safety in (0.3, 0.15):
        method = cb.AVI(safety, balanced=balanced, dissipation=scheme)
        run = prepared(free_body(comm, kind, own), method, until)
        assert run.time_sets.asynchronicity > 2
        before, position, _ = totals(run)
        for part in (1, 2):
            run.advance(round(until / run.step) * part // 2 - run.steps)
            now, _, size = totals(run)
            assert abs(now - before)[:2].max() < 1e-12 * size.max()
            exact, _ = decayed(kind, own, before[2:], position, run.time)
            error = abs(now[2:] - exact).max() / abs(before[2:]).max()
            if scheme == "exact" and own == 0:
                assert error < 1e-12
        errors.append(error)
        steps.append(run.step)
    assert np.all(abs(exact - before[2:]) > 0.1 * abs(before[2:]).max())
    if scheme != "exact" or own:
        order, measured = 1 if scheme == "forward" else 2, slopes(steps, errors)
        assert measured[-1] > order - 0.1, (measured, errors)
        assert errors[-1] < (6e-3, 4e-5)[order - 1], errors


# --- kinetic energy ------------------------------------------------------------------------------


@BALANCED
@pytest.mark.parametrize("name", ["n4", "n4 unequal rates", "n4 blocks"])
def test_kinetic_energy(comm, name, balanced):
    """½ q̇·M q̇ with all of Ω, components coupled or not."""
    case = CASES[name]
    run = prepared(build(comm, case), cb.AVI(balanced=balanced), 10.0)
    plain = reference(run, case)
    run.advance(3)
    plain.advance(3)
    expected = sum(
        0.5 * plain.p[a, ix] @ node.rate(plain.p[a, ix])
        for a, (ix, node) in enumerate(zip(plain.free, plain.nodes, strict=True))
    )
    books = run.entries()
    found = comm.allreduce(books.kinetic_u + books.kinetic_nu)
    assert found == pytest.approx(expected, rel=1e-11)
