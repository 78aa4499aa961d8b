# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a plan tells of a scene: facts against formulas, suggestions where they are due."""

import dolfinx
import numpy as np
import pytest
import scipy.linalg
import ufl
from harness import everywhere, largest, refused

import complexbody as cb
from complexbody import meshes
from complexbody.cli import main
from complexbody.errors import StepError
from complexbody.problem import Problem
from complexbody.waves import dispersion, wave_matrix

A, K, R, K0, RHO, BAR = 2.0, 0.5, 0.3, 7.0, 1.5, 0.4


def pair(eta=0.0, k0=K0, c=0.0, inertia=BAR):
    """½Au'² + ½Kν'² + Ru'ν' + ½k₀ν² + c u'ν."""
    return cb.Body(
        1, lambda U, nu, N: 0.5 * A * ufl.inner(U, U) + 0.5 * K * ufl.inner(N, N)
        + R * ufl.inner(U, N) + 0.5 * k0 * nu[0] ** 2 + c * U[0, 0] * nu[0],
        RHO, inertia, eta, displacement=1,
    )  # fmt: skip


def bar(comm, body, cells=20, length=3.0, **more):
    """Held at both ends, ν moving."""
    mesh = dolfinx.mesh.create_interval(comm, cells, [0.0, length])
    start = cb.Initial(nu=lambda x: np.sin(np.pi * x[0] / length))
    return cb.Scene(mesh, body, [cb.Fix("u", "boundary")], initial=start, **more)


def matrices(body, comm):
    problem = Problem(bar(comm, body))
    H = problem.hessian_samples(0)
    H = comm.bcast(next(h for h in comm.allgather(H) if len(h))[0])
    problem.close()
    return H, np.diag([RHO, float(np.ravel(body.inertia)[0])]), np.diag([0.0, body.viscosity])


def test_dispersion_relation(comm):
    """det(K(q) − iωD − ω²M) = 0 with a first-order coupling, damping, and without inertia."""
    for body in (pair(), pair(0.8, c=0.6), pair(0.8, c=0.6, inertia=0.0)):
        H, M, D = matrices(body, comm)
        c = 0.6 if body.viscosity else 0.0
        for q in (0.3, 2.0, -5.0):
            stiff = np.array([[A * q**2, R * q**2 - 1j * c * q], [R * q**2 + 1j * c * q,
                                                                  K * q**2 + K0]])  # fmt: skip
            np.testing.assert_allclose(wave_matrix(H, np.array([q])), stiff, atol=1e-13)
            found = dispersion(H, M, D, np.array([q]))
            assert len(found) == (4 if body.inertia else 3)
            for omega in found:
                least = scipy.linalg.svdvals(stiff - 1j * omega * D - omega**2 * M)[-1]
                assert least < 1e-10 * np.abs(stiff).max()
                assert omega.imag < 1e-12
            if not body.viscosity:
                exact = np.sqrt(scipy.linalg.eigvalsh(stiff, M))
                np.testing.assert_allclose(found.real, [-exact[1], -exact[0], *exact], rtol=1e-12)


def times(plan):
    return {(s.field, s.what): s.seconds for s in plan.scales}


def test_times_of_fields(comm):
    """Waves across a cell and the body, optical modes, diffusion where viscosity rules, the run."""
    found = times(cb.plan(bar(comm, pair()), 2.5))
    h, length = 3.0 / 20, 3.0
    assert found["u", "a wave crosses a cell"] == pytest.approx(h / np.sqrt(A / RHO))
    assert found["nu", "a wave crosses the body"] == pytest.approx(length / np.sqrt(K / BAR))
    assert found["nu", "optical modes, a period"] == pytest.approx(2 * np.pi / np.sqrt(K0 / BAR))
    assert found["run", "the whole of it"] == 2.5
    damped = times(cb.plan(bar(comm, pair(eta=50.0)), 2.5))
    assert damped["nu", "diffusion across a cell"] == pytest.approx(h**2 * 50 / K)
    assert damped["nu", "relaxation"] == pytest.approx(50 / K0)
    assert damped["nu", "viscosity stops inertia"] == pytest.approx(BAR / 50)
    light = times(cb.plan(bar(comm, pair(eta=1e-3)), 2.5))
    assert ("nu", "diffusion across a cell") not in light
    table = str(cb.plan(bar(comm, pair()), 2.5))
    assert everywhere(comm, table == comm.bcast(table))


def test_suggestions_only_where_they_are_due(comm):
    """Frozen and stiff ν, local steps: named with a number, and absent elsewhere."""

    def told(scene, until=2.5):
        return " ".join(cb.plan(scene, until).suggestions)

    assert told(bar(comm, pair(eta=1.0))) == ""
    assert "Stiff self-action" in told(bar(comm, pair(k0=1e6)))
    assert "Stiff self-action" not in told(bar(comm, pair(k0=1e6), self_action="implicit"))
    assert "Frozen" in told(bar(comm, pair(eta=1e6)))
    assert "Frozen" not in told(bar(comm, pair(eta=1e6)), 1e6)
    assert "Quasi-static" in told(bar(comm, pair(k0=1e9)))
    mesh = meshes.graded_interval(comm, np.r_[np.ones(40), 0.01, np.ones(40)])
    assert "LocalLeapfrog" in told(cb.Scene(mesh, pair(), initial=cb.Initial(u=1.0)))


def test_frozen_is_frozen(comm):
    """The estimate of a suggestion bounds what it would change."""
    body = pair(eta=3e4, c=1.0)
    start = cb.Initial(u=lambda x: np.sin(np.pi * x[0] / 3))
    mesh = dolfinx.mesh.create_interval(comm, 20, [0.0, 3.0])
    scene = cb.Scene(mesh, body, [cb.Fix("u", "boundary")], initial=start)
    text = next(s for s in cb.plan(scene, 2.0).suggestions if "Frozen" in s)
    share = float(text.split("(")[-1].rstrip(")."))
    moving = cb.simulate(scene, until=2.0)
    held = cb.Scene(scene.mesh, body, [*scene.supports, cb.Fix("nu", lambda x: x[0] > -1)],
                    initial=start)  # fmt: skip
    still = cb.simulate(held, cb.Synchronous(moving.stats.step), until=2.0)
    assert 0 < largest(comm, moving.u.x.array - still.u.x.array) < share


def test_what_a_run_says(comm, shared_path):
    """The result's plan names what was left out; ``plan=False`` leaves out nothing."""

    def energy(U, nu, N):
        return 0.5 * ufl.inner(U, U) + 0.5 * ufl.inner(N, N)

    mesh = meshes.rectangle(comm, (0, 0), (1, 1), (4, 4))
    body = cb.Body(2, energy, 1.0, 1.0, displacement=2)
    scene = cb.Scene(mesh, body, initial=cb.Initial(u=lambda x: np.stack([x[1], 0 * x[0]])))
    made = cb.simulate(scene, until=0.1).plan
    assert made.components == ("u1",) and made.left_out == ("u2", "nu1", "nu2")
    assert "u1 by initial data" in str(made)
    assert cb.simulate(scene, until=0.1, plan=False).plan is None


def test_a_step_that_those_left_allow(comm):
    """What stays zero limits no step that is given; without a plan it does."""

    def scene(stiff):
        def energy(U, nu, N):
            return 0.5 * stiff * ufl.inner(U, U) + 0.5 * ufl.inner(N, N)

        mesh = meshes.rectangle(comm, (0, 0), (1, 1), (6, 5))
        start = cb.Initial(nu=lambda x: np.cos(np.pi * x[0]))
        return cb.Scene(mesh, cb.Body(1, energy, 1.0, 1.0, displacement=2), initial=start)

    stiff, until = scene(100.0), 0.5
    step = 0.9 * cb.simulate(scene(1.0), until=until, plan=False).stats.critical
    (text,) = [s for s in cb.plan(stiff, until).suggestions if "Those left" in s]
    assert "10 times as long" in text
    assert cb.simulate(stiff, until=until).stats.critical < 0.12 * step
    found = cb.simulate(stiff, cb.Synchronous(step), until=until)
    other = cb.simulate(scene(1.0), cb.Synchronous(step), until=until, plan=False)
    assert found.stats.critical == pytest.approx(step / 0.9, rel=1e-9)
    assert largest(comm, found.nu.x.array - other.nu.x.array) < 1e-14
    with refused(StepError, "critical step"):
        cb.simulate(stiff, cb.Synchronous(step), until=until, plan=False)
    with refused(StepError, "critical step"):
        cb.simulate(stiff, cb.Synchronous(1.2 * step), until=until)


@pytest.mark.serial
def test_command(capsys, tmp_path):
    """``complexbody plan`` prints the table of a scene file."""
    assert main(["plan", "demos/standing_wave.py"]) == 0
    printed = capsys.readouterr().out
    for word in ("components", "energy", "dissipation", "inertia", "loads", "steps", "times"):
        assert word in printed
    assert main(["plan", str(tmp_path / "nothing.py")]) == 2
