# SPDX-License-Identifier: LGPL-3.0-or-later
"""Charts of speed against accuracy: errors, winners, what is kept, resuming, ranks."""

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest
from harness import refused
from mpi4py import MPI

import complexbody as cb
from complexbody import chartfile, charting, fronts, meshes
from complexbody.cli import main
from complexbody.contenders import Contender, contenders
from complexbody.errors import ChartError, CommandError
from complexbody.norms import Norms, State
from complexbody.problem import Problem
from complexbody.references import Finer, Semidiscrete
from complexbody.scenefile import SceneFile

A, K, R = 1.0, 0.6, 0.3
UNTIL = 0.7


def pair(comm, cells=16, dim=1):
    """A scalar pair on a unit interval or square, at rest in its first mode."""

    def energy(U, nu, N):
        pairs = [(U[0, i], N[0, i]) for i in range(dim)]
        return sum(0.5 * A * a**2 + 0.5 * K * b**2 + R * a * b for a, b in pairs)

    def shape(x):
        return np.prod(np.sin(np.pi * x[:dim]), axis=0)[None]

    mesh = (
        meshes.interval(comm, 0, 1, cells) if dim == 1
        else meshes.jiggled(meshes.rectangle(comm, (0, 0), (1, 1), cells), 0.15)
    )  # fmt: skip
    return cb.Scene(
        mesh, cb.Body(1, energy, 1.0, 1.0, displacement=1),
        supports=[cb.Fix("u", "boundary"), cb.Fix("nu", "boundary")],
        initial=cb.Initial(u=shape, nu=lambda x: 0.5 * shape(x)),
    )  # fmt: skip


def exact(t):
    """The pair's motion in one dimension."""
    squares, waves = np.linalg.eigh(np.pi**2 * np.array([[A, R], [R, K]]))
    part = waves.T @ [1.0, 0.5]
    q = waves @ (part * np.cos(np.sqrt(squares) * t))
    v = waves @ (-part * np.sqrt(squares) * np.sin(np.sqrt(squares) * t))
    values = dict(zip(("u", "nu", "u_dot", "nu_dot"), (*q, *v), strict=True))
    return {n: lambda x, a=a: a * np.sin(np.pi * x[:1]) for n, a in values.items()}


@pytest.fixture
def undrawn(monkeypatch):
    """Charts without their picture, which takes longer than all else here."""
    monkeypatch.setattr(charting, "draw", lambda chart, path: None)


def column(rows, method, name="fields", kind="time_error"):
    return np.array([row[kind][name] for row in rows if row["method"] == method])


def orders(rows, method, name="fields"):
    """Orders in the step between points that follow each other."""
    steps = np.array([row["step"] for row in rows if row["method"] == method])
    return np.diff(np.log(column(rows, method, name))) / np.diff(np.log(steps))


# --- errors --------------------------------------------------------------------------------------


def test_errors_fall_by_the_known_orders(comm):
    one_sided = Contender("one", "one-sided", lambda f, h: cb.Synchronous(h, start="one-sided"))
    methods = ["synchronous", "avi-windows", one_sided]
    found = cb.chart(pair(comm), UNTIL, methods, steps=4, repeats=1, comm=comm)
    for norm in ("u", "nu", "u_dot", "nu_dot", "fields", "energy_norm"):
        assert orders(found.rows, "Synchronous", norm) == pytest.approx(2, abs=0.1)
        assert orders(found.rows, "AVI, plain windows", norm) == pytest.approx(2, abs=0.15)
    for norm in ("fields", "energy_norm"):  # its rates are of order 2
        assert orders(found.rows, "one-sided", norm) == pytest.approx(1, abs=0.1)
    assert found.error == "time"
    assert all(row["total_error"] is None for row in found.rows)


def test_total_errors_against_the_exact_solution(comm):
    cells = [8, 16, 32]
    found = cb.chart(
        lambda c, cells: pair(c, cells), UNTIL, ["synchronous"], [0.2], {"cells": cells}, exact,
        repeats=1, comm=comm,
    )  # fmt: skip
    for norm in ("u", "nu", "u_dot", "nu_dot", "energy_norm"):
        errors = column(found.rows, "Synchronous", norm, "total_error")
        assert np.log2(errors[:-1] / errors[1:]) == pytest.approx(2, abs=0.1)
    assert {row["total_error"]["energy"] for row in found.rows} == {None}  # exact() says nothing


@pytest.mark.serial
def test_total_errors_against_a_finer_mesh():
    comm = MPI.COMM_SELF
    rows = [
        cb.chart(
            lambda c, cells: pair(c, cells), UNTIL, ["synchronous"], [0.1], {"cells": [8, 16]},
            solution, repeats=1, comm=comm,
        ).rows
        for solution in (None, exact)
    ]  # fmt: skip
    found, known = (column(r, "Synchronous", "u", "total_error") for r in rows)
    # The finer mesh has a quarter (1/16) of the finest's (the coarsest's) error, of the same sign.
    assert found / known == pytest.approx([1 - 1 / 16, 1 - 1 / 4], abs=0.03)


@pytest.mark.serial
def test_a_finer_mesh_is_interpolated_exactly():
    comm = MPI.COMM_SELF
    fine = Finer(pair(comm, 5, dim=2), 0.1, 1, "5")
    x = fine.fine.scene.mesh.geometry.x
    linear = np.stack([1 + x[:, 0] - 2 * x[:, 1], x[:, 1]], axis=1)
    fine.fine._row[-1] = State(linear, 2 * linear, 1.0)
    coarse = pair(comm, 3, dim=2).mesh
    y = coarse.geometry.x.copy()
    y[:, 0] *= 1.001  # some lie outside: what is linear goes on
    coarse.geometry.x[:] = y
    got = fine.state(coarse)
    np.testing.assert_allclose(got.fields, np.stack([1 + y[:, 0] - 2 * y[:, 1], y[:, 1]], axis=1))
    np.testing.assert_allclose(got.rates, 2 * got.fields)
    fine.close()


def test_reference_knows_its_own_error(comm):
    reference = Semidiscrete(pair(comm, 12), UNTIL)
    coarse, states = dict(reference.estimate), [reference.state()]
    assert reference.good_for({"fields": 1e-9, "energy_norm": 1e-9})
    assert reference.estimate["fields"] <= 1e-10 < coarse["fields"]
    # What it said of its first state was true.
    gone = reference.norms.errors(states[0], reference.state())
    assert gone["fields"] <= coarse["fields"]
    assert not reference.good_for({"fields": 1e-30})
    reference.close()


def test_norms_are_those_of_the_energy(comm):
    norms = Norms(Problem(pair(comm, 4, dim=2)))
    scene = norms.problem.scene
    x = scene.mesh.geometry.x
    # u = x, ν = 0 and u̇ = 1: ∫A|∇u|² = A, ∫ρu̇² = 1.
    fields, rates = np.zeros((2, len(x), 2))
    fields[:, 0], rates[:, 0] = x[:, 0], 1.0
    found = norms.of(State(fields, rates, -3.0))
    assert found["energy_norm"] == pytest.approx(math.sqrt(A + 1.0))
    assert found["u_dot"] == pytest.approx(1.0)
    assert (found["nu"], found["energy"]) == (0.0, 3.0)
    norms.problem.close()


# --- winners -------------------------------------------------------------------------------------


def rows_of(name, points, peer=False, status="done"):
    return [
        {"method": name, "peer": peer, "status": status, "seconds": x, "updates": 7 * x,
         "total_error": {"fields": y}, "time_error": None}
        for x, y in points
    ]  # fmt: skip


def test_front_is_what_nothing_beats():
    points = [(1, 0.5), (2, 0.6), (3, 0.1), (2.5, 0.3), (4, 0.1)]
    assert fronts.front(points) == [(1, 0.5), (2.5, 0.3), (3, 0.1)]


def test_cost_is_interpolated_in_logarithms():
    line = [(1.0, 1e-1), (100.0, 1e-3)]
    assert fronts.cost_at(line, 1e-2) == pytest.approx(10.0)
    assert fronts.cost_at(line, 1.0) == 1.0
    assert fronts.cost_at(line, 1e-3) == pytest.approx(100.0)
    assert fronts.cost_at(line, 0.9e-3) == math.inf


def test_winner_of_each_decade():
    rows = [
        *rows_of("a", [(1.0, 2e-1), (200.0, 1e-3)]),
        *rows_of("b", [(4.0, 1e-1), (8.0, 1e-2), (10.0, 1e-4)]),
        *rows_of("c", [(3.0, 1e-1), (20.0, 1e-2)], peer=True),
        *rows_of("wild", [(0.1, 1e-9)], status="unstable"),
    ]
    one, two, three, four = fronts.winners(rows)
    assert [w["error"] for w in (one, two, three, four)] == pytest.approx([0.1, 1e-2, 1e-3, 1e-4])
    assert (one["winner"], one["second"], one["open"]) == ("a", "c", False)
    assert (one["cost"], one["margin"]) == (pytest.approx(2), pytest.approx(1.5))
    assert (two["winner"], two["second"], two["margin"]) == ("b", "a", pytest.approx(20 / 8))
    assert (two["best_peer"], two["over_peer"]) == ("c", pytest.approx(20 / 8))
    assert (three["winner"], three["best_peer"], three["over_peer"]) == ("b", None, None)
    assert (four["winner"], four["second"], four["cost"]) == ("b", None, pytest.approx(10))
    assert not any(w["short"] for w in (two, three, four))


def test_a_tie_goes_to_the_first():
    points = [(2.0, 1e-1), (20.0, 1e-3)]
    rows = [*rows_of("zeta", points), *rows_of("alpha", points, peer=True)]
    for won in fronts.winners(rows):
        assert (won["winner"], won["margin"], won["over_peer"]) == ("zeta", 1.0, 1.0)


def test_winner_may_be_a_peer_and_may_be_uncertain():
    rows = [
        *rows_of("ours", [(6.0, 1e-2), (60.0, 1e-4)]),
        *rows_of("theirs", [(2.0, 1e-2), (20.0, 1e-4)], peer=True),
        *rows_of("short", [(0.1, 1e-2), (0.2, 2e-3)]),
    ]
    found = fronts.winners(rows)[1]
    assert (found["winner"], found["peer"]) == ("theirs", True)
    assert found["over_peer"] == pytest.approx(1 / 3)
    assert found["short"] == ["short"]
    assert "theirs (peer)" in fronts.table(fronts.winners(rows))


# --- what is kept --------------------------------------------------------------------------------


WILD = Contender("wild", "wild", lambda f, h: cb.Synchronous(h, unstable_ok=True))


def test_what_fails_is_kept(comm, shared_path):
    found = cb.chart(
        pair(comm, 40), 3.0, ["synchronous", WILD], [1.3, 0.8], out=shared_path, repeats=1,
        comm=comm,
    )  # fmt: skip
    states = [(row["method"], row["status"]) for row in found.rows]
    assert states == [
        ("Synchronous", "refused"), ("Synchronous", "done"), ("wild", "unstable"), ("wild", "done"),
    ]  # fmt: skip
    assert "larger than the critical step" in found.rows[0]["message"]
    assert found.rows[2]["seconds"] > 0
    assert found.rows[2]["time_error"] is None
    if comm.rank == 0:
        data = json.loads((shared_path / "chart.json").read_text())
        assert [row["status"] for row in data["rows"]] == [s for _, s in states]
        assert (shared_path / "chart.png").stat().st_size > 10_000


def test_what_takes_too_long_says_so(comm, shared_path, undrawn):
    words = dict(methods=["synchronous"], steps=1, repeats=1, comm=comm, out=shared_path)
    found = cb.chart(pair(comm), UNTIL, **words, budget=1e-9)
    assert [row["status"] for row in found.rows] == ["too long"]
    assert "budget" in found.rows[0]["message"]
    assert found.winners() == []
    again = cb.chart(pair(comm), UNTIL, **words, budget=60.0)
    assert [row["status"] for row in again.rows] == ["done"]


def comparable(rows):
    timeless = {"seconds", "wall", "runs"}
    return [{k: v for k, v in row.items() if k not in timeless} for row in rows]


def test_an_interrupted_chart_goes_on(comm, shared_path, monkeypatch, undrawn):
    methods, meshes_ = ["synchronous", "avi-exact", "local-leapfrog"], {"cells": [8, 12]}

    def made(out):
        return cb.chart(
            lambda c, cells: pair(c, cells), UNTIL, methods, 2, meshes_, exact, shared_path / out,
            repeats=1, comm=comm,
        )  # fmt: skip

    whole = made("whole")
    put, left = chartfile.ChartFile.put, [0]

    def stopping(self, row):
        put(self, row)
        left[0] -= 1
        if left[0] == 0:
            raise KeyboardInterrupt

    monkeypatch.setattr(chartfile.ChartFile, "put", stopping)
    for left[0] in (3, 5):
        with pytest.raises(KeyboardInterrupt):
            made("parts")
    monkeypatch.undo()
    parts, again = made("parts"), made("parts")
    assert len(whole.rows) == 12
    assert comparable(parts.rows) == comparable(whole.rows)
    assert again.rows == parts.rows  # nothing is run again, not even for its time
    assert parts.references == whole.references


def test_a_chart_of_another_scene_is_refused(comm, shared_path, undrawn):
    words = dict(methods=["synchronous"], steps=1, out=shared_path, repeats=1, comm=comm)
    cb.chart(pair(comm, 8), UNTIL, **words)
    with refused(ChartError, "until", "--fresh"):
        cb.chart(pair(comm, 8), 2 * UNTIL, **words)
    assert len(cb.chart(pair(comm, 8), 2 * UNTIL, **words, fresh=True).rows) == 1


def test_requests_that_make_no_sense(comm):
    scene = pair(comm, 8)
    for words, told in (
        (dict(until=-1.0), "until"), (dict(meshes={"cells": [8]}), "function"),
        (dict(steps=0), "steps"), (dict(norm="taste"), "norm"), (dict(repeats=0), "repeats"),
    ):  # fmt: skip
        with refused(ChartError, told):
            cb.chart(scene, **{"until": UNTIL, "comm": comm, **words})
    with refused(CommandError, "No method 'magic'", "synchronous"):
        cb.chart(scene, UNTIL, ["magic"], comm=comm)
    if comm.size > 1:
        with refused(ChartError, "one process"):
            cb.chart(lambda c, cells: pair(c, cells), UNTIL, meshes={"cells": [8]}, comm=comm)


# --- ranks, command line -------------------------------------------------------------------------


def test_errors_do_not_depend_on_ranks(comm):
    methods = ["synchronous", "avi", "avi-exact", "local-leapfrog"]
    here, alone = (
        cb.chart(pair(c, 6, dim=2), UNTIL, methods, 2, repeats=1, comm=c).rows
        for c in (comm, MPI.COMM_SELF)
    )
    for one, other in zip(here, alone, strict=True):
        assert one["status"] == other["status"] == "done"
        assert one["updates"] == other["updates"]
        for name, error in one["time_error"].items():
            assert error == pytest.approx(other["time_error"][name], rel=1e-6, abs=1e-9)


def test_every_method_has_a_name_and_steps():
    known = contenders()
    assert list(known)[:2] == ["synchronous", "avi"]
    assert len({c.name for c in known.values()}) == len(known)
    for c in known.values():
        assert np.diff(np.log(c.factors(3))) == pytest.approx(-math.log(c.ratio))


SCENES = Path(__file__).parents[1] / "benchmarks" / "scenes"


@pytest.mark.parametrize("name", ["bar", "phason"])
def test_scenes_have_their_exact_solution(name, comm, shared_path, undrawn):
    words = ["--methods", "synchronous", "--steps", "0.1", "--meshes", "cells=12,24", "--quiet"]
    words += ["--until", "0.3", "--repeats", "1", "--out", str(shared_path)]
    # The rate of an overdamped ν follows forces that are late by part of a step.
    words += ["--set", "viscosity=2"] if name == "phason" else []
    assert main(["chart", str(SCENES / f"{name}.py"), *words]) == 0
    if comm.rank == 0:
        rows = json.loads((shared_path / "chart.json").read_text())["rows"]
        for norm in ("u", "nu", "u_dot", "nu_dot"):
            coarse, fine = (row["total_error"][norm] for row in rows)
            assert math.log2(coarse / fine) == pytest.approx(2, abs=0.2)


@pytest.mark.parametrize(("name", "least"), [("notch", 64), ("plate", 32)])
def test_scenes_are_graded(name, least, comm):
    file = SceneFile(SCENES / f"{name}.py")
    made = file.scene(comm, file.complete({}))
    sizes = meshes.altitudes(made.mesh)
    low, high = -comm.allreduce(-sizes.min(initial=np.inf), MPI.MAX), comm.allreduce(
        sizes.max(initial=0.0), MPI.MAX
    )  # fmt: skip
    assert high / low > least
    found = cb.chart(made, 0.02, ["local-leapfrog"], 1, repeats=1, comm=comm)
    assert [row["status"] for row in found.rows] == ["done"]


def test_every_scene_is_charted():
    text = (SCENES.parents[1] / "Makefile").read_text()
    names = {path.stem for path in SCENES.glob("*.py")}
    assert names == {"bar", "notch", "phason", "plate"}
    assert all(f"$(call CHART,{name})" in text for name in names)


SCENE = """
import numpy as np
import complexbody as cb
from complexbody import meshes
DEFAULTS = dict(until=0.5)
def scene(comm, cells=8):
    body = cb.Body(1, lambda U, nu, N: U[0, 0]**2 + N[0, 0]**2, 1.0, 1.0, displacement=1)
    start = lambda x: np.sin(np.pi * x[:1])
    return cb.Scene(meshes.interval(comm, 0, 1, cells), body, [cb.Fix("u", "boundary")],
                    initial=cb.Initial(u=start), name="string")
def exact(t):
    w = np.sqrt(2) * np.pi
    return {"u": lambda x: np.cos(w * t) * np.sin(np.pi * x[:1]), "nu": lambda x: 0 * x[:1]}
"""


def test_command_line(comm, shared_path, capsys, undrawn):
    path, out = shared_path / "string.py", shared_path / "out"
    if comm.rank == 0:
        path.write_text(SCENE)
    comm.Barrier()
    words = ["chart", str(path), "--methods", "synchronous,local-leapfrog", "--repeats", "1"]
    words += ["--out", str(out)]
    assert main([*words, "--meshes", "cells=8,16", "--steps", "2"]) == 0
    told = capsys.readouterr().out
    if comm.rank == 0:
        assert told.count("Synchronous") >= 4
        assert "The cheapest method by total error" in told
        data = json.loads((out / "chart.json").read_text())
        assert data["schema"] == "complexbody chart 1"
        assert {"machine", "versions", "commit", "settings", "winners"} <= set(data)
        assert data["references"]["cells=16"]["estimate"]["fields"] > 0
        with (out / "chart.csv").open() as file:
            table = list(csv.DictReader(file))
        assert len(table) == len(data["rows"]) == 8
        assert float(table[0]["total_fields"]) == data["rows"][0]["total_error"]["fields"]
        assert data["rows"][0]["time_error"]["nu"] is None  # ν never moves
    for wrong in (
        ["--steps", "many"], ["--meshes", "cells=x"], ["--meshes", "size=3"],
        ["--methods", "magic"], ["--until", "-1"],
    ):  # fmt: skip
        assert main([*words, *wrong]) == 2
