# SPDX-License-Identifier: LGPL-3.0-or-later
"""``complexbody stability``: predictions against runs, critical steps, warnings, the command."""

import csv
import json
import warnings
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from harness import everywhere, refused
from mpi4py import MPI
from verification.test_windows_stability import SAMPLES, sample

import complexbody as cb
from complexbody import bars, meshes, resonances, stability_report
from complexbody.cli import main
from complexbody.criticalsteps import critical_steps
from complexbody.disturbed import Disturbed
from complexbody.errors import IntegratorError
from complexbody.growth import RunMap, long_run
from complexbody.instabilities import known_instabilities
from complexbody.problem import Problem
from complexbody.stability import SCHEDULES, point, stability
from complexbody.timesets import cell_steps

LEFT = lambda x: x[0] < 1e-9  # noqa: E731
GROWS = 1e-3
ENDS = np.arange(0.95, 1, 0.002)  # narrow bands


def pair(dim, viscosity=0.0, quartic=0.0):
    """½|∇u|² + 0.3|∇ν|² + 0.3∇u·∇ν + ¼ν², and a little ν⁴ if wanted."""

    def energy(U, nu, N):
        value = 0.25 * nu[0] ** 2 + quartic * nu[0] ** 4
        for i in range(dim):
            value += 0.5 * U[0, i] ** 2 + 0.3 * N[0, i] ** 2 + 0.3 * U[0, i] * N[0, i]
        return value

    return cb.Body(1, energy, 1.0, 1.0, viscosity, displacement=1)


def square(comm, cells=3, grade=1.0, **options):
    mesh = meshes.jiggled(meshes.rectangle(comm, [0, 0], [1, 1], cells), 0.2)
    if grade > 1:
        x = mesh.geometry.x
        x[:, :2] = np.expm1(np.log(grade) * x[:, :2]) / (grade - 1)
    return cb.Scene(mesh, pair(2, **options), [cb.Fix("u", LEFT), cb.Fix("nu", LEFT)])


def of_bar(comm, ratio, coarse=6, fine=6):
    sizes = np.array([float(ratio)] * coarse + [1.0] * fine)
    mesh = meshes.graded_interval(comm, sizes / sizes.sum())
    start = cb.Initial(nu=lambda x: np.sin(40 * x[:1]))
    return cb.Scene(mesh, pair(1), [cb.Fix("u", LEFT), cb.Fix("nu", LEFT)], initial=start)


# --- predicted against measured -------------------------------------------------------------------


@pytest.mark.serial
@pytest.mark.parametrize("ratio, windows", [(2, True), (3, False)])
def test_two_springs(ratio, windows):
    """Band edges and peak growth of actual runs are those of the closed formula."""
    rows = bars.two_springs(ratio, windows)
    table = "\n".join(stability_report.springs_table(bars.Bars(springs=rows)))
    assert f"{rows[0]['low']:.4f}" in table and rows[0]["schedule"] in table
    assert len(rows) == ratio - 1
    known = {2: [(1.1547, 1.4142)], 3: [(0.902, 1.0), (1.581, 1.732)]}[ratio]
    for row, (low, high) in zip(rows, known, strict=True):
        assert (row["low"], row["high"]) == pytest.approx((low, high), abs=1e-3)
        assert row["low_measured"] == pytest.approx(row["low"], rel=1e-3)
        assert row["high_measured"] == pytest.approx(row["high"], rel=1e-3)
        assert row["measured"] == pytest.approx(row["predicted"], rel=0.05)
        # |λ| ≈ c/2 + √(1 + c²/4) at the peak.
        theta = 2 * np.arcsin(row["omega"] / 2)
        c = row["omega"] ** 2 / ratio / np.sin(theta)
        estimate = c / 2 + np.sqrt(1 + c * c / 4) - 1
        assert row["measured"] == pytest.approx(estimate, rel=0.05)


@pytest.mark.serial
@pytest.mark.parametrize("ratio", ["3/2", "2", "4"])
def test_bars(ratio):
    """Maps made of runs, and long runs, are those of plain matrices."""
    ratio = Fraction(ratio)
    bar, alphas = bars.Bar(ratio), np.append(np.arange(0.4, 0.95, 0.01), ENDS)
    for name in bars.PREDICTED:
        growth = bars.predicted(name, ratio, alphas)
        some = [10, 41, int(growth.argmax())]
        found = [bar.growth(bars.BARS[name](float(a))) for a in alphas[some]]
        assert found == pytest.approx(growth[some], abs=2e-7)
        rows = bars.check(name, bar, growth, alphas)
        assert rows
        for row in rows:
            assert row["predicted"] > GROWS
            assert row["measured"] == pytest.approx(row["predicted"], rel=0.05)


@pytest.mark.serial
def test_first_unstable():
    """Bars: known first bands, nothing where no mode is met."""
    assert resonances.resonance_free(2) == pytest.approx(np.sqrt(0.5))
    for ratio, first in ((2, 0.726), (3, 0.56), (4, 0.47), (6, 0.394)):
        found, growth = resonances.first_unstable(ratio)
        assert found == pytest.approx(first, abs=0.02)
        assert growth > 0.05
        below = np.linspace(0.05, resonances.resonance_free(ratio), 200)
        assert resonances.two_rate_growth(ratio, (1, ratio), below).max() < 1e-7
    assert resonances.first_unstable(4, 0.45) == (np.inf, 0.0)


@pytest.mark.serial
@pytest.mark.parametrize("ratio", ["5/4", "2", "7/2", "6"])
def test_defaults_on_bars(ratio):
    """No default grows on bars; what is known to grow does."""
    bar = bars.Bar(Fraction(ratio))
    for method in (cb.Synchronous(), cb.AVI(), cb.LocalLeapfrog()):
        assert bar.growth(method) < 1e-6, method
    unstable = {
        "5/4": (bars.BARS["real steps"], [0.999]),
        "2": (bars.BARS["balanced windows"], [0.9]),
        # Thin bands.
        "7/2": (bars.BARS["local leapfrog, no filter"], np.arange(0.49, 0.53, 0.0025)),
        "6": (bars.BARS["plain windows"], np.arange(0.8, 0.95, 0.03)),
    }
    make, alphas = unstable[ratio]
    assert max(bar.growth(make(float(a))) for a in alphas) > GROWS


@pytest.mark.serial
@pytest.mark.parametrize("grade", [1.0, 9.0])
def test_defaults_on_squares(grade):
    """No default grows by 1e-3 per coarse step on scattered squares."""
    found = stability(square(MPI.COMM_SELF, 4, grade), safeties=[0.45, 0.9], critical=False)
    for p in found.points:
        if p.safety == SCHEDULES[p.schedule].default:
            assert not p.unstable and p.growth < GROWS, p
            assert p.how == ("long run" if "AVI" in p.schedule or "real" in p.schedule else "map")
    assert len(found.points) == 2 * len(SCHEDULES)


@pytest.mark.serial
@pytest.mark.slow
def test_defaults_on_many_meshes():
    """No default grows on scattered and graded meshes; plain windows do on some that are graded."""
    grown = {"told": [], "not told": []}
    for name in SAMPLES:
        if name.startswith("3D"):
            continue
        for coupled in (False, True):
            problems = Disturbed.pair(sample(name, coupled))
            for method in (cb.AVI(), cb.LocalLeapfrog()):
                assert point(problems, "", 0.0, method, dense=900).growth < 1e-6, (name, method)
            plain = cb.AVI(balanced=False)
            told = known_instabilities(problems[0], plain)
            growth = point(problems, "", 0.0, plain, dense=900).growth
            grown["told" if told else "not told"].append(growth)
    found = {kind: sum(g > GROWS for g in values) for kind, values in grown.items()}
    assert found["told"] >= 5 and found["not told"] == 0, grown


# --- critical steps -------------------------------------------------------------------------------


@pytest.mark.serial
@pytest.mark.parametrize("viscosity", [0.0, 30.0])
def test_critical_steps(viscosity):
    """Cells' bound ≤ the body's own = measured, with every dissipation scheme."""
    pytest.importorskip("slepc4py")
    found = stability(square(MPI.COMM_SELF, viscosity=viscosity), schedules=[])
    assert [row.scheme for row in found.critical] == ["exact", "symmetric", "forward"]
    for row in found.critical:
        assert row.elemental <= row.overall * (1 + 1e-9)
        assert row.measured == pytest.approx(row.overall, rel=2e-3)
        assert row.how == "spectral radius"
    exact, symmetric, forward = (row.overall for row in found.critical)
    assert symmetric <= exact <= forward
    assert (forward > 1.01 * symmetric) == (viscosity > 0)


def test_critical_steps_by_runs(comm):
    """The same from long runs, on any number of ranks; the scene's loads do not matter."""
    pytest.importorskip("slepc4py")
    scene = square(comm)
    problems = Disturbed.pair(scene)
    assert len(problems) == 1
    row = critical_steps(problems, "exact", steps=3000, dense=0)
    assert row.how == "runs of 3000 steps"
    assert row.measured == pytest.approx(row.overall, rel=3e-3)
    assert comm.allgather(row.measured) == [row.measured] * comm.size


def test_not_linear(comm):
    """Two runs slightly apart: stable at the bound, and unstable somewhere above."""
    row = critical_steps(Disturbed.pair(square(comm, 2, quartic=0.1)), "exact", steps=1000)
    assert row.overall is None and "not linear" in row.how
    assert row.elemental < row.measured < 1.6 * row.elemental


def test_growth_on_ranks(comm):
    """A long run grows as the map does, on any number of ranks."""
    scene, method = of_bar(comm, 4), cb.AVI(0.9, balanced=False)
    found = point(Disturbed.pair(scene), "", 0.9, method, steps=3000, dense=0)
    alone = point(Disturbed.pair(of_bar(MPI.COMM_SELF, 4)), "", 0.9, method)
    assert (found.how, alone.how) == ("long run", "map")
    assert alone.growth > 0.01
    assert everywhere(comm, found.growth == pytest.approx(alone.growth, rel=0.05))


@pytest.mark.serial
def test_map():
    """The map of a run does what the run does, balanced or not, damped or not."""
    for method, size in ((cb.AVI(), 3), (cb.AVI(balanced=False), 2), (cb.LocalLeapfrog(), 2)):
        problem = Disturbed(of_bar(MPI.COMM_SELF, 3))
        run = method.prepare(problem, 1e9)
        matrix = RunMap(run).matrix()
        assert len(matrix) >= size * 12
        state = np.random.default_rng(0).normal(size=len(matrix))
        assert RunMap(run)(state) == pytest.approx(matrix @ state, abs=1e-12)
    slow = Disturbed(of_bar(MPI.COMM_SELF, 3))
    run = cb.Synchronous(unstable_ok=True, safety=1.1).prepare(slow, 1e9)
    growth = np.log(RunMap(run).radius())
    run = cb.Synchronous(unstable_ok=True, safety=1.1).prepare(slow, 1e9)
    assert long_run([run], 2000) == pytest.approx(growth, rel=0.01)


# --- warnings -------------------------------------------------------------------------------------


def test_known_instabilities(comm):
    """Told where measured, not at the defaults, not where a run is too short to see it."""
    problem = Problem(of_bar(comm, 8))
    defaults = (cb.AVI(), cb.LocalLeapfrog(), cb.Synchronous(), cb.AVI(0.45, balanced=False))
    for method in defaults[:3]:
        assert known_instabilities(problem, method, 1e6) == []
    (told,) = known_instabilities(problem, defaults[3])
    assert "neighbouring cells differ by up to 8" in told and "α = 0.35" in told
    assert known_instabilities(problem, defaults[3], 1.0) == []
    assert known_instabilities(problem, cb.AVI(0.15, balanced=False)) == []
    planned = str(cb.plan(of_bar(comm, 8), integrator=defaults[3]))
    assert "unstable" in planned and "neighbouring" in planned
    assert "unstable" not in str(cb.plan(of_bar(comm, 8), integrator=cb.AVI()))
    (told,) = known_instabilities(problem, cb.AVI(schedule="exact"))
    assert "real steps" in told
    real = problem.disc.source_cell >= 0
    steps = np.zeros(problem.disc.count)
    steps[problem.disc.source_cell[real]] = 0.4 * cell_steps(problem)[real]
    (told,) = known_instabilities(problem, cb.AVI(schedule="exact", steps=steps))
    assert "the chosen 0.4." in told
    assert known_instabilities(problem, cb.AVI(schedule="octaves", balanced=False)) == []
    (told,) = known_instabilities(problem, cb.AVI(0.8))
    assert "balanced windows at α = 0.8" in told
    (told,) = known_instabilities(problem, cb.LocalLeapfrog(stabilisation=0.0))
    assert "stabilisation=0" in told and "0.11" in told
    assert known_instabilities(problem, cb.LocalLeapfrog(stabilisation=0.0, levels=0)) == []
    uniform = Problem(of_bar(comm, 1))
    for method in (*defaults, cb.AVI(0.9), cb.LocalLeapfrog(stabilisation=0.0)):
        assert known_instabilities(uniform, method) == []
    scene = square(comm, 4, 100.0)
    (told,) = known_instabilities(Problem(scene), cb.AVI(0.2, balanced=False))
    assert "graded by 16 or more" in told
    for method in defaults[:3]:
        assert known_instabilities(Problem(scene), method, 1e6) == []


def test_slow_growth_in_space(comm):
    """Viscosity in 3D on graded meshes: a word only before very long runs."""
    mesh = meshes.box(comm, [0] * 3, [1] * 3, 3)
    x = mesh.geometry.x
    x[:] = np.expm1(np.log(100.0) * x) / 99
    problem = Problem(cb.Scene(mesh, pair(3, 2.0), [cb.Fix("u", LEFT), cb.Fix("nu", LEFT)]))
    assert known_instabilities(problem, cb.AVI()) == []
    assert known_instabilities(problem, cb.AVI(), 1e2) == []
    (told,) = known_instabilities(problem, cb.AVI(), 1e6)
    assert "viscosity" in told and "so long a run" in told


def test_simulate_warns(comm):
    """Before any stepping, as Python warns, on rank 0; nothing at the defaults."""
    scene = of_bar(comm, 8)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        cb.simulate(scene, cb.AVI(0.7, balanced=False), until=20.0, growth=None)
    words = [str(w.message) for w in told if "neighbouring" in str(w.message)]
    assert len(words) == (comm.rank == 0)
    cb.simulate(scene, cb.AVI(), until=20.0)  # warnings are errors here


# --- the command ----------------------------------------------------------------------------------

SCENE = """
import numpy as np
import complexbody as cb
from complexbody import meshes
from complexbody.forms import isotropic_two_field

def scene(comm, cells=6):
    return cb.Scene(
        meshes.interval(comm, 0.0, 1.0, cells),
        isotropic_two_field(d=1, viscosity=0.1, name="rubber"),
        supports=[cb.Fix("u", where=lambda x: x[0] < 1e-9, value=0.1)],
        loads=[cb.BodyForce((1.0,))],
        name="bar",
    )
"""


@pytest.fixture
def file(comm, shared_path):
    path = shared_path / "bar.py"
    if comm.rank == 0:
        path.write_text(SCENE)
    comm.barrier()
    return path


def test_command(comm, file, shared_path, capsys):
    out = shared_path / "found"
    words = [
        "stability",
        str(file),
        "--set",
        "cells=7",
        "--safeties",
        "0.45,0.9",
        "--out",
        str(out),
    ]
    words += ["--schedules", "synchronous, plain windows", "--steps", "1000"]
    assert main(words) == 0
    shown = capsys.readouterr().out
    if comm.rank == 0:
        assert "cells=7" in shown and "critical steps" in shown and "plain windows" in shown
        assert "none" in shown
        found = json.loads((out / "stability.json").read_text())
        assert {"machine", "versions", "commit", "critical", "points"} <= set(found)
        assert [c["scheme"] for c in found["critical"]] == ["exact", "symmetric", "forward"]
        with (out / "stability.csv").open() as table:
            rows = list(csv.DictReader(table))
        assert len(rows) == 4 == len(found["points"])
        assert (out / "stability.png").read_bytes()[:4] == b"\x89PNG"
    else:
        assert shown == ""


@pytest.mark.parametrize(
    "words",
    [[], ["FILE", "--bars"], ["FILE", "--safeties", "a,b"], ["FILE", "--safeties", "0:1:0"],
     ["FILE", "--schedules", "waltz"], ["FILE", "--steps", "3"]],
)  # fmt: skip
def test_command_refuses(file, capsys, words):
    given = [str(file) if word == "FILE" else word for word in words]
    assert main(["stability", *given, "--quiet"]) == 2
    capsys.readouterr()


def test_refusals(comm):
    with refused(IntegratorError, "waltz", "balanced windows"):
        stability(square(comm), schedules=["waltz"])
    with refused(IntegratorError, "backward", "exact"):
        stability(square(comm), dissipation="backward")


@pytest.mark.serial
def test_refused_rows():
    """An integrator that cannot take a scene has a row that says why."""

    def energy(U, nu, N):
        return 0.5 * (1 + nu[0] ** 2) * U[0, 0] ** 2 + 0.5 * N[0, 0] ** 2

    body = cb.Body(1, energy, 1.0, 1.0, displacement=1)
    scene = cb.Scene(meshes.interval(MPI.COMM_SELF, 0, 1, 5), body, [cb.Fix("u", LEFT)])
    found = stability(
        scene, safeties=[0.45], schedules=["synchronous", "local leapfrog"], critical=False,
        steps=500,
    )  # fmt: skip
    assert [bool(p.refused) for p in found.points] == [False, True]
    table = "\n".join(stability_report.growth_table(found))
    assert "refused: LocalLeapfrog needs energies" in table


@pytest.mark.serial
def test_implicit_self_action():
    """Every run has the inertia of its own step: nothing of it is left to the next."""
    scene = replace(of_bar(MPI.COMM_SELF, 4), self_action="implicit")
    problems = Disturbed.pair(scene)
    first, _, again = (point(problems, "", a, cb.AVI(a)) for a in (0.3, 0.6, 0.3))
    assert (first.growth, first.step) == (again.growth, again.step)
    rows = [critical_steps(problems, scheme) for scheme in ("exact", "symmetric")]
    for row in rows:
        assert row.overall is None and row.measured >= row.elemental


@pytest.mark.serial
def test_small_bars(tmp_path, capsys):
    """The bars' tables and files, on a small grid."""
    alphas = np.arange(0.5, 1.0, 0.2)
    found = bars.bars([Fraction(3, 2), Fraction(6)], alphas, alphas, springs=())
    assert set(found.maps) == set(bars.BARS)
    for name, part in found.maps.items():
        assert np.shape(part["growth"]) == (2, len(alphas))
        assert (part["apart"] is not None) == (name in bars.PREDICTED)
    text = "\n".join(stability_report.bars_table(found))
    assert "3/2" in text and "real steps" in text
    paths = stability_report.write_bars(found, tmp_path, MPI.COMM_SELF)
    assert [path.suffix for path in paths] == [".json", ".csv", ".png"]
    with paths[1].open() as table:
        rows = list(csv.DictReader(table))
    grown = sum(np.sum(np.array(part["growth"]) > 1e-9) for part in found.maps.values())
    assert len(rows) == grown > 2
    assert json.loads(paths[0].read_text())["maps"].keys() == found.maps.keys()
    assert paths[2].read_bytes()[:4] == b"\x89PNG"
