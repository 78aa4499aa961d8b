# SPDX-License-Identifier: LGPL-3.0-or-later
"""From scene to result: what comes out, when, and that looking at a run does not disturb it.

The reference is a standing wave of the scheme itself: cos ωt at every step, ω from the discrete
dispersion relation. Between steps an interpolated output must be O(h³) away from that cosine.
"""

import csv
import math

import numpy as np
import pytest
import ufl
from busy import LEFT, RIGHT, busy
from dense import prepared, quadratic, random_hessian, slopes
from harness import everywhere, largest, refused
from mpi4py import MPI

import complexbody as cb
from complexbody import _compat, meshes
from complexbody.errors import IntegratorError, OutputError, SceneError, StepError
from complexbody.forms import isotropic_two_field
from complexbody.halo import Halo
from complexbody.stepping import hermite

STIFF, OWN, CELLS = 1.0, 0.4, 10
SIDES = (cb.Fix("u", "boundary"), cb.Fix("nu", "boundary"))
FIELDS = ("u", "nu", "u_dot", "nu_dot")


def sine(x):
    return np.sin(np.pi * x[:1])


def wave(comm, supports=SIDES, **given):
    """At rest with u = 0 and ν = sin πx; ω follows from :func:`omega`."""

    def energy(U, nu, N):
        return 0.5 * U[0, 0] ** 2 + 0.5 * STIFF * N[0, 0] ** 2 + 0.5 * OWN * nu[0] ** 2

    body = cb.Body(1, energy, 1.0, 1.0, displacement=1)
    initial = cb.Initial(nu=sine)
    mesh = meshes.interval(comm, 0, 1, CELLS)
    return cb.Scene(mesh, body, supports, initial=initial, self_action="lumped", **given)


def omega(h):
    """Discrete frequency of :func:`wave`: sin²(ωh/2) = h²λ/4."""
    square = STIFF * 4 * CELLS**2 * np.sin(np.pi / (2 * CELLS)) ** 2 + OWN
    return 2 / h * np.arcsin(0.5 * h * np.sqrt(square))


def written(folder, name):
    """Times, points and values of a field's file, on any rank."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(folder / f"{name}.h5", locking=False) as file:
        steps = file[f"Function/{name}"]
        order = sorted(steps, key=int)
        times = np.array([steps[i].attrs["time"] for i in order])
        return times, np.array(file["Mesh/mesh/geometry"]), np.array([steps[i] for i in order])


# --- output between steps -------------------------------------------------------------------------


def test_output_between_steps(comm, shared_path):
    """Fields at any time are O(h³) from the scheme's own motion, rates O(h²); at steps exact."""
    steps, errors = [], []
    for count in (20, 40, 80):
        h, folder = 1.0 / count, shared_path / str(count)
        output = cb.Output(folder, every=0.013)
        cb.simulate(wave(comm), cb.Synchronous(h), until=1.0, output=output)
        comm.barrier()
        times, points, values = written(folder, "nu")
        np.testing.assert_allclose(times, [*(0.013 * np.arange(77)), 1.0], atol=1e-14)
        shape, w = np.sin(np.pi * points[:, 0]), omega(h)
        error = abs(values[:, :, 0] - np.cos(w * times)[:, None] * shape).max(axis=1)
        assert error[0] == 0.0 or error[0] < 1e-15
        on_step = abs(times / h - np.round(times / h)) < 1e-6
        assert on_step.sum() >= 2 and error[on_step].max() < 1e-13
        _, _, rates = written(folder, "nu_dot")
        rate_error = abs(rates[:, :, 0] + w * np.sin(w * times)[:, None] * shape).max()
        errors.append([error.max(), rate_error])
        steps.append(h)
    measured = slopes(np.array(steps)[:, None], errors)[-1]
    assert measured[0] > 2.9 and measured[1] > 1.95, measured
    assert errors[0][0] < 1e-3


def test_moving_supports_between_steps(comm, shared_path):
    """Prescribed motion is met as well between steps: O(h³) at the support."""
    history, steps, errors = cb.sine(0.8, 0.4), [], []
    for count in (20, 40, 80):
        supports = [cb.Fix("u", LEFT), cb.Fix("nu", LEFT, 0.3, history=history)]
        scene = wave(comm, supports)
        output = cb.Output(shared_path / str(count), every=0.013)
        cb.simulate(scene, cb.Synchronous(1.0 / count), until=1.0, output=output)
        comm.barrier()
        times, points, values = written(shared_path / str(count), "nu")
        at = values[:, np.argmin(points[:, 0]), 0]
        errors.append(abs(at - 0.3 * history(times)).max())
        steps.append(1.0 / count)
    assert slopes(steps, errors)[-1] > 2.9, errors


@pytest.mark.parametrize("scheme", ["exact", "symmetric", "forward"])
def test_end_between_steps(comm, scheme):
    """A step that does not divide the run is kept: the final state is that at ``until``."""
    steps, errors = [], []
    for count in (20, 40, 80):
        h, until = 1 / (count + 0.37), 1.0
        result = cb.simulate(wave(comm), cb.Synchronous(h, dissipation=scheme), until=until)
        assert result.stats.step == h and result.stats.steps == count + 1
        assert result.time == until and result.ledger["time"][-1] == (count + 1) * h
        points, w = result.nu.function_space.mesh.geometry.x, omega(h)
        shape = np.sin(np.pi * points[:, 0])
        error = largest(comm, result.nu.x.array - np.cos(w * until) * shape)
        rate_error = largest(comm, result.nu_dot.x.array + w * np.sin(w * until) * shape)
        errors.append([error, rate_error])
        steps.append(h)
    measured = slopes(np.array(steps)[:, None], errors)[-1]
    assert measured[0] > 2.9 and measured[1] > 1.9, measured


def test_shorter_than_a_step(comm):
    """Also where the run ends before its first step does."""
    result = cb.simulate(wave(comm), cb.Synchronous(0.05), until=0.013)
    assert result.stats.steps == 1
    points = result.nu.function_space.mesh.geometry.x
    expected = np.cos(omega(0.05) * 0.013) * np.sin(np.pi * points[:, 0])
    assert largest(comm, result.nu.x.array - expected) < 2e-3


def test_hermite():
    """Cubics are interpolated exactly, with their slopes."""
    cubic = np.polynomial.Polynomial([0.3, -1.2, 0.7, 0.9])
    t0, h = 0.4, 0.25
    ends = [np.array([p(t)]) for t in (t0, t0 + h) for p in (cubic, cubic.deriv())]
    for s in np.linspace(0, 1, 7):
        x, v = hermite(s, h, *ends)
        assert x[0] == pytest.approx(cubic(t0 + s * h), abs=1e-14)
        assert v[0] == pytest.approx(cubic.deriv()(t0 + s * h), abs=1e-13)


@pytest.mark.parametrize(
    "dim, kind, quartic",
    [(2, "blocks", 0.0), (3, "numbers", 0.0), (1, "no inertia", 0.0), (2, "numbers", 3.0)],
)
@pytest.mark.parametrize("moving", [True, False])
def test_looking_does_not_disturb(comm, shared_path, dim, kind, quartic, moving):
    """Output, probes and ledger change no bit of the final state."""
    scene = busy(comm, dim, kind, quartic)
    if not moving:
        supports = [cb.Fix("u", LEFT), cb.Fix("nu", RIGHT, components=0)]
        scene = cb.Scene(scene.mesh, scene.body, supports, scene.loads, scene.initial,
                         cell_tags=scene.cell_tags)  # fmt: skip
    step = prepared(scene, cb.Synchronous()).step
    until, ends = 40.4 * step, []
    probes = {"middle": (0.5, 0.4, 0.3)[:dim]}
    for number, (ledger_steps, output) in enumerate([
        (1000, None),
        (1, None),
        (7, cb.Output(shared_path / "a", every=2.3 * step, fields=("u",))),
        (4, cb.Output(shared_path / "b", every=0.7 * step, probes=probes, probe_steps=3)),
    ]):  # fmt: skip
        result = cb.simulate(
            scene, cb.Synchronous(step), until=until, output=output, ledger_steps=ledger_steps
        )
        ends.append([getattr(result, name).x.array.copy() for name in FIELDS])
        same = all(np.array_equal(a, b) for a, b in zip(ends[0], ends[-1], strict=True))
        assert everywhere(comm, same), number


# --- probes, ledger, results ----------------------------------------------------------------------


def test_probes(comm, shared_path):
    """Values between nodes, every few steps, in memory of rank 0 and in a table."""
    h, at = 1 / 40, 0.537
    output = cb.Output(shared_path, probes={"here": (at,), "there": (0.2,)}, probe_steps=3)
    result = cb.simulate(wave(comm), cb.Synchronous(h), until=1.0, output=output)
    if comm.rank > 0:
        assert result.probes == {}
        return
    nodes = np.arange(CELLS + 1) / CELLS
    table = result.probes["here"]
    np.testing.assert_allclose(table["time"], 3 * h * np.arange(14), rtol=1e-14)
    value, cosine = np.interp(at, nodes, np.sin(np.pi * nodes)), np.cos(omega(h) * table["time"])
    np.testing.assert_allclose(table["nu"][:, 0], cosine * value, atol=1e-13)
    assert table["u"].shape == (14, 1) and not table["u"].any()
    value = np.sin(0.2 * np.pi)
    there = result.probes["there"]["nu"][:, 0]
    np.testing.assert_allclose(there, cosine * value, atol=1e-13)
    with (shared_path / "probe-here.csv").open() as file:
        lines = list(csv.reader(file))
    assert lines[0][0].startswith("time") and "s" in lines[0][0]
    read = np.array(lines[1:], float)
    np.testing.assert_array_equal(read[:, 0], table["time"])
    np.testing.assert_array_equal(read[:, 2], table["nu"][:, 0])


@pytest.mark.parametrize("every", [1, 7, 40, 1000])
def test_ledger_rows(comm, shared_path, every):
    """A row at 0, every so many steps, and at the end, in memory and in ledger.csv."""
    h, output = 1 / 40, cb.Output(shared_path, fields=())
    result = cb.simulate(
        wave(comm), cb.Synchronous(h), until=1.0, ledger_steps=every, output=output
    )
    expected = [*(i * h for i in range(0, 40, every)), 40 * h]
    np.testing.assert_array_equal(result.ledger["time"], expected)
    with pytest.raises(ValueError):
        result.ledger["no such column"]
    comm.barrier()
    with (shared_path / "ledger.csv").open() as file:
        lines = list(csv.reader(file))
    assert len(lines[0]) == len(result.ledger.columns) == len(result.ledger.units())
    np.testing.assert_array_equal(np.array(lines[1:], float), result.ledger.rows)


def test_ledger_by_default(comm):
    """A short run has about a hundred rows at least, or one per step."""
    few = cb.simulate(wave(comm), cb.Synchronous(1 / 30), until=1.0).ledger
    assert len(few) == 31
    many = cb.simulate(wave(comm), cb.Synchronous(1 / 450), until=1.0).ledger
    assert 100 <= len(many) <= 120


def test_energies_of_the_first_row(comm):
    """At t = 0 the ledger has the energies of the initial data, by hand."""
    body = cb.Body(1, quadratic(random_hessian(1, 1, 1, 1), 1), 1.4, 0.6, displacement=1)
    initial = cb.Initial(u=lambda x: 0.3 * x[:1], nu=0.7, u_dot=0.5, nu_dot=-0.2)
    scene = cb.Scene(meshes.interval(comm, 0, 2, 9), body, initial=initial)
    ledger = cb.simulate(scene, until=0.01).ledger
    g = np.array([0.3, 0.0, 0.7])
    known = {
        "kinetic_u": 2 * 0.5 * 1.4 * 0.5**2,
        "kinetic_nu": 2 * 0.5 * 0.6 * 0.2**2,
        "stored": 2 * 0.5 * g @ random_hessian(1, 1, 1, 1) @ g,
        "momentum_1": 2 * 1.4 * 0.5,
        "work": 0.0, "dissipated": 0.0, "balance": 0.0, "variation_u": 0.0,
    }  # fmt: skip
    for column, value in known.items():
        assert ledger[column][0] == pytest.approx(value, rel=1e-13, abs=1e-300), column


def test_result(comm, shared_path):
    """Fields are blocked P1 Functions on the scene's mesh; statistics say what was done."""
    scene = busy(comm, 2, "blocks")
    result = cb.simulate(scene, until=0.3, output=cb.Output(shared_path, fields=("u",)))
    assert result.scene is scene and result.folder == shared_path and result.time == 0.3
    for name in FIELDS:
        function = getattr(result, name)
        assert function.name == name and function.function_space.mesh is scene.mesh
        assert function.x.array.size == 2 * _compat.node_count(scene.mesh)
    stats = result.stats
    assert stats.cells == 2 * 6 * 4 and stats.nodes == 7 * 5 and stats.ranks == comm.size
    assert stats.steps * stats.step == pytest.approx(0.3, rel=1e-14)
    assert 0.8 * stats.critical < stats.step <= 0.9 * stats.critical * (1 + 1e-12)
    # One evaluation of the forces per step, and one for the state at the end.
    assert stats.updates == stats.cells * (stats.steps + 1)
    assert stats.rate > 0 and stats.bytes_per_cell > 0
    assert cb.simulate(scene, until=0.01).folder is None


def test_scene_is_as_it_was(comm):
    """A scene can be simulated again, with the same bits: nothing is left behind in it."""
    scene = busy(comm, 2, "numbers")
    first = cb.simulate(scene, until=0.2)
    cb.simulate(scene, cb.Synchronous(dissipation="forward"), until=0.1)
    again = cb.simulate(scene, until=0.2)
    assert everywhere(comm, np.array_equal(first.nu.x.array, again.nu.x.array))


# --- local steps ----------------------------------------------------------------------------------


LOCAL = [cb.AVI(), cb.AVI(balanced=False), cb.AVI(schedule="exact"), cb.LocalLeapfrog()]


@pytest.mark.parametrize("method", LOCAL)
def test_local_steps(comm, shared_path, method, monkeypatch):
    """Integrators with local steps give results like the others, and free their communicators."""
    halos, made = [], Halo.__init__

    def noted(self, *given, **options):
        made(self, *given, **options)
        halos.append(self)

    monkeypatch.setattr(Halo, "__init__", noted)
    body, mesh = isotropic_two_field(d=2), meshes.rectangle(comm, (0, 0), (1, 1), 8)
    mesh.geometry.x[:, 0] = mesh.geometry.x[:, 0] ** 3
    shape = cb.Initial(u=lambda x: np.cos(np.pi * x[:2]))
    scene, results = cb.Scene(mesh, body, initial=shape), []
    for each in (cb.Synchronous(safety=0.1), method):
        halos.clear()
        output = cb.Output(shared_path / type(each).__name__, every=0.03)
        results.append(cb.simulate(scene, each, until=0.1, output=output))
        if comm.size > 1:
            assert halos and all(halo.comm == MPI.COMM_NULL for halo in halos)
    exact, found = results
    assert found.stats.step > 2 * found.stats.critical and found.time == 0.1
    assert 0 < found.stats.updates < 0.25 * exact.stats.updates
    scale = largest(comm, exact.u.x.array)
    assert largest(comm, found.u.x.array - exact.u.x.array) < 0.05 * scale
    comm.barrier()
    folders = [shared_path / type(each).__name__ for each in (cb.Synchronous(), method)]
    (times, _, expected), (same, _, values) = (written(folder, "u") for folder in folders)
    np.testing.assert_array_equal(times, same)
    assert abs(values - expected).max() < 0.05 * scale


# --- refusals -------------------------------------------------------------------------------------


@pytest.mark.parametrize("until", [0.0, -1.0, math.nan, math.inf])
def test_end_that_is_none(comm, until):
    with refused(SceneError, "until"):
        cb.simulate(wave(comm), until=until)


def test_refusals(comm, shared_path):
    """What cannot be run says so before it starts, on all ranks."""
    scene = wave(comm)
    for steps in (0, -3):
        with refused(SceneError, "ledger_steps"):
            cb.simulate(scene, until=1.0, ledger_steps=steps)
    with refused(StepError, "critical", "unstable_ok=True"):
        cb.simulate(scene, cb.Synchronous(1.0), until=2.0)
    for name, value in (("step", 0.0), ("step", -1.0), ("step", math.nan), ("safety", 0.0)):
        with refused(StepError, name):
            cb.Synchronous(**{name: value})
    for name in ("dissipation", "start", "critical"):
        with refused(IntegratorError, name, "quick"):
            cb.Synchronous(**{name: "quick"})
    chi = lambda nu, v: (1 + nu[0] ** 2) * v[0] ** 2  # noqa: E731
    body = cb.Body(1, lambda U, nu, N: ufl.inner(U, U) + ufl.inner(N, N), 1.0, chi, displacement=1)
    for method in (cb.Synchronous(), cb.AVI(), cb.LocalLeapfrog()):
        with refused(IntegratorError, "constant inertia", type(method).__name__, "Implicit()"):
            cb.simulate(cb.Scene(scene.mesh, body), method, until=1.0)
    file = shared_path / "file"
    if comm.rank == 0:
        file.write_text("in the way")
    comm.barrier()
    with refused(OutputError, "file"):
        cb.simulate(scene, until=1.0, output=cb.Output(file / "results"))
    with refused(SceneError, "probe"):
        output = cb.Output(shared_path, probes={"outside": (1.5,)})
        cb.simulate(scene, until=1.0, output=output)


def test_moving_part_of_a_coupled_descriptor(comm):
    """Only what the equations can take: all components of ν, or u alone, where Ω couples."""
    omega_matrix = np.array([[1.0, 0.3], [0.3, 0.8]])
    base = quadratic(random_hessian(2, 2, 2, 1), 1)
    body = cb.Body(2, base, 1.0, omega_matrix, displacement=2)
    mesh, swing = meshes.interval(comm, 0, 1, 8), cb.sine(0.5)

    def run(*supports):
        return cb.simulate(cb.Scene(mesh, body, supports), until=1.0, ledger_steps=1)

    u, first = cb.Fix("u", LEFT, 0.1, history=swing), cb.Fix("nu", LEFT, 0.1, 0, swing)
    for supports in ([first], [u, first]):
        with refused(IntegratorError, "components"):
            run(*supports)
    one = cb.Fix("u", LEFT, 0.1, 0, swing)
    for supports in ([one], [u], [first, cb.Fix("nu", LEFT, components=1)]):
        result = run(*supports)
        assert abs(result.ledger["identity"]).max() < 1e-11
        assert abs(result.ledger["support_work"]).max() > 1e-5


def test_a_refused_run_leaves_nothing(comm, shared_path):
    """An error on the way leaves no files of a run that never was."""
    scene = wave(comm)
    with refused(StepError, "critical"):
        cb.simulate(scene, cb.Synchronous(9.0), until=20.0, output=cb.Output(shared_path / "new"))
    assert not (shared_path / "new").exists()
