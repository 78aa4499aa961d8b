"""The command line: what it prints and writes, and how it ends, on every number of ranks."""

import csv
import json
import os
import re
import signal
import subprocess
import sys
import textwrap
import threading
import time

import h5py
import numpy as np
import pytest

import complexbody as cb
from complexbody import commands, errors, machine, native, report, statefile, together
from complexbody.cli import main, parser
from complexbody.scenefile import SceneFile

BAR = '''"""A bar that rings."""
import numpy as np
import complexbody as cb
from complexbody import meshes
from complexbody.forms import isotropic_two_field

DEFAULTS = dict(until=0.5, every=0.1, fields=("u", "nu"), probes={"mid": (0.5,)}, probe_steps=5)

def scene(comm, cells=20, load=None):
    loads = [] if load is None else [cb.BodyForce((1.0,), history=load)]
    return cb.Scene(
        meshes.interval(comm, 0.0, 1.0, cells),
        isotropic_two_field(d=1, viscosity=0.1, name="rubber"),
        supports=[cb.Fix("u", where=lambda x: x[0] < 1e-9)],
        loads=loads,
        initial=cb.Initial(u=lambda x: np.sin(0.5 * np.pi * x[:1])),
        name="bar",
    )
'''
CHECK = """
def check(result):
    balance = np.abs(result.ledger["balance"]).max()
    assert balance < 1e-2, f"balance {balance}"
    return f"balance below 1e-2 at t = {result.time}"
"""
PICTURE = """
def picture(result, path):
    if result.u.function_space.mesh.comm.rank == 0:
        path.write_text("drawn")
"""
LEAPFROG = ("--integrator", "local-leapfrog")
#: A bar whose last cell is a 32nd of the others.
GRADED = """
def scene(comm):
    return cb.Scene(
        meshes.graded_interval(comm, [1 / 16] * 16 + [1 / 512]),
        isotropic_two_field(d=1, name="rubber"),
        supports=[cb.Fix("u", where=lambda x: x[0] < 1e-9)],
        initial=cb.Initial(u=lambda x: np.sin(np.pi * x[:1])),
        name="graded bar",
    )
"""
_BOTH = (
    "--set --until --integrator --step --safety --dissipation --start --critical --unstable-ok "
    "--balanced --stabilisation --levels --force --kind --debug"
)
OPTIONS = {
    "run": f"{_BOTH} --accuracy --out --every --fields --probe --probe-steps --ledger-steps "
    "--no-plan --no-picture --speed-up --quiet",
    "check": _BOTH,
    "plan": _BOTH,
    "stability": "--bars --set --no-map --no-critical --safeties --schedules --dissipation --steps "
    "--dense --out --no-picture --quiet --debug",
    "chart": "--set --until --methods --meshes --steps --repeats --budget --norm --out --fresh "
    "--quiet --debug",
    "show": "--debug",
    "resume": "--until --debug",
    "info": "--debug",
}


@pytest.fixture
def bar(comm, shared_path):
    """A function that writes BAR and more, once for all ranks, and returns its path in words."""

    def writer(*more, name="bar.py"):
        comm.Barrier()
        path = shared_path / name
        if comm.rank == 0:
            path.write_text("".join((BAR, *more)), encoding="utf-8")
        comm.Barrier()
        return str(path)

    return writer


@pytest.fixture
def call(comm, capsys):
    """A function that calls main and returns its exit code, output and error of rank 0."""

    def caller(*words):
        capsys.readouterr()
        code = main([str(word) for word in words])
        out, err = capsys.readouterr()
        assert comm.allgather(code) == [code] * comm.size
        if comm.rank > 0:
            assert (out, err) == ("", "")
        return (code, *comm.bcast((out, err)))

    return caller


def record(folder):
    return json.loads((folder / "run.json").read_text(encoding="utf-8"))


def flat(text):
    return " ".join(text.split())


# --- run ---------------------------------------------------------------------------------------


def test_run_is_simulate(bar, call, comm, shared_path):
    path, out = bar(), shared_path / "out"
    code, _, err = call("run", path, "--set", "cells=12", "--start", "one-sided", "--out", out)
    assert (code, err) == (0, "")
    direct = shared_path / "direct"
    output = cb.Output(direct, 0.1, fields=("u", "nu"), probes={"mid": (0.5,)}, probe_steps=5)
    scene = SceneFile(path).scene(comm, {"cells": 12})
    result = cb.simulate(scene, cb.Synchronous(start="one-sided"), until=0.5, output=output)
    row = dict(zip(result.ledger.columns, result.ledger.rows[-1], strict=True))
    if comm.rank > 0:
        return
    assert record(out)["ledger"] == pytest.approx(row, rel=1e-13, abs=1e-15)
    for name in ("ledger.csv", "probe-mid.csv"):
        tables = [_table(folder / name) for folder in (out, direct)]
        assert tables[0][0] == tables[1][0]
        np.testing.assert_allclose(tables[0][1], tables[1][1], rtol=1e-13, atol=1e-15)
    for name in ("u", "nu"):
        with h5py.File(out / f"{name}.h5") as one, h5py.File(direct / f"{name}.h5") as two:
            steps = one[f"Function/{name}"]
            assert len(steps) == 6
            for number in steps:
                values = two[f"Function/{name}/{number}"][:]
                np.testing.assert_allclose(steps[number][:], values, rtol=1e-13, atol=1e-15)


def _table(path):
    with path.open(encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    return header, np.array(rows, dtype=float)


def test_run_writes_down_what_it_did(bar, call, comm, shared_path):
    path, out = bar(CHECK), shared_path / "out"
    code, _, _ = call("run", path, "--set", "cells=12", "--safety", "0.5", "--out", out)
    assert code == 0
    found = record(out)
    assert found["state"] == "finished"
    assert found["command"].startswith("complexbody run ")
    assert "--set cells=12 --safety 0.5" in found["command"]
    assert found["parameters"] == {"cells": 12, "load": None}
    assert found["settings"]["safety"] == 0.5
    assert found["settings"]["until"] == 0.5
    assert found["scene"] == "bar"
    assert found["bodies"]["rubber"]["mu"] == 1.0
    assert found["ranks"] == comm.size
    for name in ("complexbody", "dolfinx", "petsc", "numpy", "python"):
        assert found["versions"][name][0].isdigit()
    assert found["versions"]["numpy"] == np.__version__
    assert set(found["machine"]) >= {"host", "cpu", "cores", "system"}
    assert found["commit"] is None or len(found["commit"].rstrip("+")) == 40
    assert found["statistics"]["cells"] == 12
    assert found["statistics"]["nodes"] == 13
    assert found["statistics"]["step"] <= 0.5 * found["statistics"]["critical"]
    assert found["ledger"]["time"] == pytest.approx(0.5)
    assert found["check"] == "balance below 1e-2 at t = 0.5"
    assert found["seconds"] > 0
    assert len(found["sha256"]) == 64


def test_run_says_what_it_does(bar, call, comm, shared_path):
    path, out = bar(CHECK, PICTURE), shared_path / "out"
    code, text, err = call("run", path, "--out", out, "--probe", "end=1.0")
    assert (code, err) == (0, "")
    text = flat(text)
    ranks = "1 rank" if comm.size == 1 else f"{comm.size} ranks"
    for words in (
        f"bar ({path}), cells=20, load=None",
        f"mesh 1D, 20 cells, 21 nodes, on {ranks}",
        "body rubber: n_u=1, k=1, density 1, inertia 1, viscosity 0.1, lam=1,",
        "integrator synchronous (order 2): safety=0.9, dissipation=exact",
        "0.88 of the critical 0.028398 s; 20 of them to t = 0.5 s",
        "bytes per cell",
        f"output {out}: u, nu at 6 times; ledger every 1 step; probes mid, end every 5 steps",
        "time set-up",
        "million cell updates per second and core",
        "ledger energy balance within",
        "check balance below 1e-2 at t = 0.5",
        f"files {out}",
    ):
        assert words in text
    assert (out / "picture.png").read_text() == "drawn"
    assert record(out)["picture"] == "picture.png"
    again = call("run", path, "--out", out)[1]
    assert "(replaces an earlier run)" in flat(again)


def test_quiet_prints_nothing(bar, call, shared_path):
    path, out = bar(CHECK, PICTURE), shared_path / "out"
    assert call("run", path, "--quiet", "--no-picture", "--out", out) == (0, "", "")
    assert not (out / "picture.png").exists()
    assert record(out)["check"] == "balance below 1e-2 at t = 0.5"


@pytest.mark.parametrize(
    ("words", "settings"),
    [
        ((), {"until": 0.5, "every": 0.1, "fields": ("u", "nu"), "probes": {"mid": (0.5,)}}),
        (("--until", "0.2"), {"until": 0.2}),
        (("--every", "0.05"), {"every": 0.05}),
        (("--fields", "u_dot, stress"), {"fields": ("u_dot", "stress")}),
        (("--fields", "none"), {"fields": ()}),
        (("--probe", "a=0.2", "--probe", "mid=0.3"), {"probes": {"mid": (0.3,), "a": (0.2,)}}),
        (("--probe-steps", "2", "--ledger-steps", "3"), {"probe_steps": 2, "ledger_steps": 3}),
        (("--integrator", "synchronous", "--step", "1e-3"), {"step": 1e-3}),
        (("--dissipation", "forward", "--critical", "cells"), {"dissipation": "forward"}),
        (("--unstable-ok",), {"unstable_ok": True}),
        (
            ("--integrator", "local-leapfrog", "--stabilisation", "0.1", "--levels", "2"),
            {"integrator": "local-leapfrog", "stabilisation": 0.1, "levels": 2},
        ),
        (("--integrator", "assembled-leapfrog", "--force", "matrix"), {"force": "matrix"}),
        (("--integrator", "petsc-ts", "--kind", "cn", "--step", "0.1"), {"kind": "cn"}),
    ],
)
def test_options_go_before_defaults(bar, words, settings):
    file = SceneFile(bar())
    found = commands._settings(parser().parse_args(["run", "bar.py", *words]), file)
    assert {name: found[name] for name in settings} == settings
    assert file.defaults["probes"] == {"mid": (0.5,)}


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("assembled-leapfrog", "--force", "matrix"), "discrete energy identity"),
        (("newmark", "--step", "0.05"), "linear iterations per step"),
        (("petsc-ts", "--kind", "theta", "--step", "0.05", "--petsc", "pc_type=sor"), "not limit"),
    ],
)
def test_peers(bar, call, shared_path, words, told):
    words = ("--integrator", *words, "--no-picture", "--out", shared_path / "out")
    code, text, err = call("run", bar(), *words)
    assert (code, err) == (0, "") and told in text, text


def test_every_goes_before_times(bar):
    file = SceneFile(bar("DEFAULTS = dict(times=(0.1, 0.2))\n"))
    found = commands._settings(parser().parse_args(["run", "bar.py", "--every", "0.1"]), file)
    assert found == {"every": 0.1}


def test_ledger_rows_and_fields_are_those_asked_for(bar, call, comm, shared_path):
    out = shared_path / "out"
    words = ("--ledger-steps", "5", "--fields", "none", "--out", out)
    assert call("run", bar(), *words)[0] == 0
    assert len(_table(out / "ledger.csv")[1]) == 5
    assert not list(out.glob("*.h5"))


@pytest.mark.parametrize("integrator", ["avi", "local-leapfrog"])
def test_local_steps(bar, call, comm, shared_path, integrator):
    """check and run say the same of a step above the critical one, and do not call it unstable."""
    path, out = bar(GRADED), shared_path / "out"
    code, checked, err = call("check", path, "--integrator", integrator)
    assert (code, err) == (0, "")
    assert "speed-up over one step for all: 11.3 ideal" in flat(checked)
    code, text, err = call("run", path, "--integrator", integrator, "--out", out, "--speed-up")
    assert (code, err) == (0, "")
    assert "speed-up over one step for all: 11.3 ideal" in flat(text)
    told = [line for line in text.splitlines() if line.startswith("  time sets   steps ")]
    assert len(told) == 1 and told[0] in checked
    name = {"avi": "window", "local-leapfrog": "coarse step"}[integrator]
    told = [line for line in text.splitlines() if line.startswith(f"  step        {name} ")]
    assert len(told) == 1 and told[0] in checked
    assert "times the smallest cell's critical step of 0.001" in flat(text)
    assert "UNSTABLE" not in checked + text
    found = record(out)
    assert found["settings"]["integrator"] == integrator
    assert found["statistics"]["step"] > 3 * found["statistics"]["critical"]
    assert found["time_sets"]["cells"] == 17
    assert found["time_sets"]["window"] == found["statistics"]["step"]
    # A 17th of the cells steps 32 times as often.
    alone = 17 * found["settings"]["until"] / (0.9 * found["statistics"]["critical"])
    assert found["statistics"]["updates"] < 0.6 * alone


# --- errors ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (("walk",), 2, "invalid choice: 'walk'"),
        (("run",), 2, "required: FILE. See complexbody run --help."),
        (("run", "FILE", "--untill", "3"), 2, "unrecognized arguments: --untill 3"),
        (("run", "FILE", "--until", "soon"), 2, "argument --until: invalid float value: 'soon'"),
        (("run", "FILE", "--until", "-1"), 2, "Give the end of the run in seconds"),
        (("run", "FILE", "--until", "nan"), 2, "Give the end of the run in seconds"),
        (("run", "FILE", "--start", "late"), 2, "argument --start: invalid choice"),
        (("run", "FILE", "--integrator", "rk4"), 2, "argument --integrator: invalid choice"),
        (("run", "FILE", "--set", "cells"), 2, "--set cells: not name=value"),
        (("run", "FILE", "--set", "sells=3"), 2, "no parameter sells. Its parameters: cells=20"),
        (("run", "FILE", "--set", "cells=-3"), 2, "in scene()"),
        (("run", "FILE", "--probe", "0.5"), 2, "--probe 0.5: not name=x,y,z"),
        (("run", "FILE", "--probe", "out=3"), 2, "Outside the body: probe 'out'"),
        (("run", "FILE", "--probe", "p=0.5,0.5"), 2, "not a point of a mesh with 1 dimensions"),
        (("run", "FILE", "--fields", "v"), 2, "field 'v' is not known"),
        (("run", "FILE", "--every", "0"), 2, "Give a positive time"),
        (("run", "FILE", "--step", "1"), 2, "larger than the critical step"),
        (("run", "FILE", "--safety", "-1"), 2, "safety is -1.0. Give a positive number"),
        (("run", "FILE", "--ledger-steps", "0"), 2, "Give a whole number from 1"),
        (("run", "FILE", "--probe-steps", "0"), 2, "Give a whole number from 1"),
        (("run", "FILE", "--out", "/proc/nowhere"), 2, "/proc/nowhere"),
        (("run", "nowhere.py"), 2, "nowhere.py cannot be read"),
        (("check", "nowhere.py"), 2, "nowhere.py cannot be read"),
        (("check", "FILE", "--step", "1"), 2, "larger than the critical step"),
        (("check", "FILE", "--set", "cells=-3"), 2, "in scene()"),
        (("run", "FILE", "--levels", "2"), 2, "Integrator synchronous has no option levels"),
        (("run", "FILE", *LEAPFROG, "--levels", "-1"), 2, "levels is -1. Give 0 to 20"),
        (("run", "FILE", *LEAPFROG, "--stabilisation", "-1"), 2, "stabilisation is -1.0. Give"),
        (("check", "FILE", *LEAPFROG, "--balanced"), 2, "has no option balanced. It has"),
    ],
)
def test_errors(bar, call, shared_path, words, code, message):
    path = bar()
    words = [path if word == "FILE" else word for word in words]
    if words[0] == "run" and "--out" not in words:
        words += ["--out", shared_path / "out"]
    found, _, err = call(*words)
    assert found == code
    assert message in err
    assert err.startswith("complexbody: error: ")
    assert len(err.splitlines()) == 1
    assert "Traceback" not in err


def test_messages_name_options(bar, call, shared_path):
    _, _, err = call("run", bar(), "--step", "1", "--out", shared_path / "out")
    assert "or --unstable-ok to see it happen" in err


def test_something_must_say_when_to_stop(bar, call):
    code, _, err = call("run", bar("DEFAULTS = {}\n"))
    assert code == 2
    assert "Give --until T, or DEFAULTS = dict(until=…)" in err


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ("DEFAULTS = dict(until=0.5, integrator='rk4')\n", "No integrator 'rk4'. Give one of"),
        ("DEFAULTS = dict(until=0.5, dissipation='no')\n", "dissipation='no' is not known"),
        ("DEFAULTS = dict(until=0.5, stop=1)\n", "DEFAULTS has unknown stop"),
        ("def scene(comm): return 3\n", "scene() returned a int"),
        ("1 / 0\n", "ZeroDivisionError: division by zero"),
    ],
)
def test_wrong_scene_files(bar, call, shared_path, more, message):
    code, _, err = call("run", bar(more), "--out", shared_path / "out")
    assert code == 2
    assert message in err


def test_debug_shows_the_traceback(bar, call, shared_path):
    path = bar("def scene(comm): return 1 / 0\n")
    code, _, err = call("check", path, "--debug")
    assert code == 2
    assert "Traceback" in err
    assert "ZeroDivisionError: division by zero\n" in err
    assert err.splitlines()[-1].startswith("complexbody: error: ")


def test_an_error_on_one_rank_ends_all(bar, call, comm):
    text = f"""
plain = scene
def scene(comm):
    made = plain(comm)
    if comm.rank == {comm.size - 1}:
        raise ValueError("mine")
    return made
"""
    code, _, err = call("check", bar(text))
    assert code == 2
    assert "ValueError: mine" in err
    assert (f"(rank {comm.size - 1})" in err) == (comm.size > 1)


def test_a_body_that_is_not_coercive_is_an_error(bar, call):
    text = """
    def scene(comm):
        body = cb.Body(1, lambda U, nu, N: U[0, 0]**2 + N[0, 0]**2 + 3 * U[0, 0] * N[0, 0], 1, 1,
                       displacement=1)
        return cb.Scene(meshes.interval(comm, 0.0, 1.0, 8), body)
    """
    for command in ("check", "run"):
        code, _, err = call(command, bar(textwrap.dedent(text)))
        assert code == 2
        assert "not coercive (A1)" in err
        assert "U11" in err


def test_diverging_runs(bar, call, comm, shared_path):
    out = shared_path / "out"
    words = ("--step", "0.06", "--unstable-ok", "--until", "60", "--every", "60", "--out", out)
    with np.errstate(all="ignore"):
        code, text, err = call("run", bar("DEFAULTS = {}\n"), *words)
    assert code == 4
    assert "(UNSTABLE)" in text
    assert "became non-finite by t = " in err
    assert record(out)["state"].startswith("failed: Values became non-finite")


def test_a_failed_check(bar, call, shared_path):
    path, out = bar("def check(result):\n    assert 1 > 2, 'less'\n", PICTURE), shared_path / "out"
    code, text, err = call("run", path, "--out", out)
    assert code == 5
    assert "less" in err
    assert "check  " not in text
    assert "less" in record(out)["check"]
    assert record(out)["state"].startswith("failed: Check failed")
    assert record(out)["statistics"]["steps"] == 20
    assert (out / "picture.png").exists()  # where it may be most useful


def test_a_check_that_fails_on_one_rank(bar, call, comm, shared_path):
    text = f"""
def check(result):
    assert result.u.function_space.mesh.comm.rank != {comm.size - 1}, "mine"
"""
    code, _, err = call("run", bar(text), "--out", shared_path / "out")
    assert code == 5
    assert "mine" in err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("raise MissingPackage('No GL. Run: apt-get install libosmesa6')", "install libosmesa6"),
        ("import no_such_module", "no_such_module"),
    ],
)
def test_a_picture_for_which_something_is_missing(bar, call, shared_path, text, message):
    head = "from complexbody.errors import MissingPackage\n"
    path = bar(head, f"def picture(result, path):\n    {text}\n")
    code, _, err = call("run", path, "--out", shared_path / "out")
    assert code == 0
    assert err.startswith("complexbody: warning: no picture: ")
    assert message in err
    assert record(shared_path / "out")["state"] == "finished"
    assert message in record(shared_path / "out")["picture"]


def test_vtk_is_not_given_the_chance_to_crash(bar, call, shared_path, monkeypatch):
    def no_gl():
        raise errors.MissingPackage("VTK cannot draw here. Run: apt-get install libosmesa6")

    monkeypatch.setattr(commands, "require_vtk", no_gl)
    text = "def picture(result, path):\n    import os, pyvista\n    os.abort()\n"
    code, _, err = call("run", bar(text), "--out", shared_path / "out")
    assert code == 0
    assert "no picture: VTK cannot draw here. Run: apt-get install libosmesa6" in err


def test_a_wrong_picture_is_an_error(bar, call, shared_path):
    code, _, err = call("run", bar("def picture(r, p): r.x\n"), "--out", shared_path / "out")
    assert code == 2
    assert "in picture(): AttributeError" in err
    assert record(shared_path / "out")["statistics"]["steps"] == 20


def test_a_bug_is_told_as_one(call, comm, monkeypatch):
    def broken(arguments, ranks):
        if comm.rank == 0:
            raise RuntimeError("unheard of")

    monkeypatch.setattr(commands, "info", broken)
    code, _, err = call("info")
    assert code == 1
    assert "Traceback" in err
    assert "RuntimeError: unheard of. Please report it." in err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_leave_readable_files(bar, call, comm, shared_path, number):
    before = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    text = f"""
import os, signal
tried = []
def stopping(t):
    if np.max(t) > 0.3 and not tried:
        tried.append(t)  # before the run
    elif np.max(t) > 0.3:
        os.kill(os.getpid(), {int(number)})
    return np.ones_like(np.asarray(t, dtype=float))
plain = scene
def scene(comm): return plain(comm, load=stopping)
"""
    out = shared_path / "out"
    code, _, err = call("run", bar(text), "--out", out)
    name = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM"}[number]
    assert code == 128 + number
    assert err == f"complexbody: stopped by {name}; what was written until then is in {out}\n"
    assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] == before
    assert record(out)["state"] == f"stopped by {name}"
    if comm.rank == 0:
        with h5py.File(out / "u.h5") as file:
            times = sorted(step.attrs["time"] for step in file["Function/u"].values())
        np.testing.assert_allclose(times[:3], [0.0, 0.1, 0.2])
        assert 'Value="0.2"' in (out / "u.xdmf").read_text()
        assert len(_table(out / "ledger.csv")[1]) >= 1


# --- resume ------------------------------------------------------------------------------------


def test_resume_goes_on_where_the_run_was(bar, call, comm, shared_path):
    """Options come from run.json; without checkpoints, or of another scene, the exit code is 6."""
    path, whole, out = bar(CHECK), shared_path / "whole", shared_path / "out"
    words = ("--set", "cells=16", "--step", "0.01", "--every", "0.1")
    assert call("run", path, *words, "--out", whole)[0] == 0
    assert call("run", path, *words, "--out", out, "--checkpoint-steps", "20")[0] == 0
    if comm.rank == 0:
        newest, *_ = statefile.listed(out / "checkpoints")
        newest.unlink()
    comm.barrier()
    code, text, err = call("resume", out)
    assert (code, err) == (0, "")
    assert "resumed     at t = 0.4 s, from step-000000000040.npz, to the bit" in text
    assert "check " in text and "replaces" not in text
    assert record(out)["statistics"]["steps"] == 50
    if comm.rank == 0:
        for name in ("ledger.csv", "probe-mid.csv"):
            assert (out / name).read_bytes() == (whole / name).read_bytes()
    comm.barrier()
    code, text, err = call("resume", out, "--until", "0.7")
    assert (code, err) == (0, "")
    assert record(out)["ledger"]["time"] == pytest.approx(0.7)
    code, _, err = call("resume", out, "--until", "0.3")
    assert code == 6 and "is at t = 0.7 s already" in err
    code, _, err = call("resume", shared_path / "nowhere")
    assert code == 6 and "has no run to resume" in err
    assert call("run", path, *words, "--out", out, "--checkpoint-every", "0")[0] == 0
    code, _, err = call("resume", out)  # those of the run before are not its own
    assert code == 6 and "No checkpoint in" in err
    code, _, err = call("resume", shared_path / "whole")  # has one, of its end
    assert code == 0, err
    bar("Y = 1\n" + CHECK.replace("def check", "plain = scene\ndef scene(comm, cells=20):\n"
        "    return plain(comm, cells + 1)\n\ndef check"))  # fmt: skip
    code, _, err = call("resume", whole)
    assert code == 6 and "of another run: it has another mesh" in err


# --- check -------------------------------------------------------------------------------------


def test_check_says_what_run_would_do(bar, call, comm, shared_path, monkeypatch):
    monkeypatch.chdir(shared_path)
    code, text, err = call("check", bar(), "--set", "cells=16")
    assert (code, err) == (0, "")
    text = flat(text)
    for words in (
        "mesh 1D, 16 cells, 17 nodes",
        "energy rubber: coercive (A1), smallest relative eigenvalue 0.8",
        "generated kernel",
        "forces linear",
        "factor of 1 at most",
        "of them to t = 0.5 s",
        "bytes per cell",
        "time about",
    ):
        assert words in text
    assert sorted(p.name for p in shared_path.iterdir()) == ["bar.py"]  # it writes nothing


def test_check_without_an_end(bar, call):
    code, text, _ = call("check", bar("DEFAULTS = {}\n"))
    assert code == 0
    assert "give --until T for an estimate" in text


def test_check_steps_are_those_of_run(bar, call, shared_path):
    path = bar()
    words = (path, "--dissipation", "forward", "--until", "0.7")
    told = next(line for line in call("check", *words)[1].splitlines() if "  step  " in line)
    assert told in call("run", *words, "--out", shared_path / "out")[1]


def test_check_finds_the_worst_cell(bar, call):
    text = """
def scene(comm):
    sizes = [1.0] * 5 + [0.1] + [1.0] * 14
    return cb.Scene(meshes.graded_interval(comm, sizes), isotropic_two_field(d=1, k0=0.0))
DEFAULTS = {}
"""
    code, out, _ = call("check", bar(text))
    assert code == 0
    out = flat(out)
    assert "(the worst cell, at 5.05)" in out
    assert "the worst cell makes the run 10 times as long" in out
    assert "1 cell is below half the median" in out
    # 20 cells at the smallest step against 19 + 10.
    assert f"factor of {200 / 29:.3g} at most" in out


def test_check_tells_of_locking(bar, call):
    text = """
def scene(comm, lam=60.0):
    mesh = meshes.rectangle(comm, (0, 0), (1, 1), 4)
    return cb.Scene(mesh, isotropic_two_field(d=2, lam=lam))
DEFAULTS = {}
"""
    code, out, err = call("check", bar(text), "--set", "lam=60")
    assert (code, err) == (0, "")
    assert "coercive (A1), smallest relative eigenvalue" in flat(out)
    assert "is nearly incompressible: volume changes cost as much as with λ/μ = 60" in flat(out)
    assert "incompressible" not in flat(call("check", bar(text), "--set", "lam=40")[1])


def test_check_tells_bodies_apart(bar, call):
    text = """
import ufl
from dolfinx.mesh import meshtags
def scene(comm):
    mesh = meshes.interval(comm, 0.0, 1.0, 8)
    cells = np.arange(mesh.topology.index_map(1).size_local, dtype=np.int32)
    middle = mesh.geometry.x[_compat.cell_nodes(mesh)[cells], 0].mean(axis=1)
    tags = meshtags(mesh, 1, cells, np.where(middle < 0.5, 1, 2).astype(np.int32))
    soft = cb.Body(1, lambda U, nu, N: U[0, 0]**4 + U[0, 0]**2 + nu[0]**2 + N[0, 0]**2, 1, 1,
                   displacement=1, name="foam")
    half = cb.Body(1, lambda U, nu, N: (U[0, 0] + nu[0])**2 + N[0, 0]**2, 1, 1, displacement=1,
                   name="glue")
    return cb.Scene(mesh, {1: soft, 2: half}, cell_tags=tags)
from complexbody import _compat
DEFAULTS = dict(until=0.1)
"""
    code, out, err = call("check", bar(text))
    assert (code, err) == (0, "")
    out = flat(out)
    assert "body foam (cell tag 1)" in out
    assert "energy foam: not quadratic, so A1 depends on the state" in out
    assert "FFCx kernel" in out
    assert "energy glue: semidefinite (A1). The energy of glue does not see the mode" in out
    assert "forces nonlinear" in out


# --- info and help -----------------------------------------------------------------------------


def test_info(call, monkeypatch):
    code, out, _ = call("info")
    assert code == 0
    for words in ("dolfinx", "petsc", "numpy", "compiler", "doubles per vector", "SLEPc", "GL"):
        assert words in out
    assert str(native.cache_folder()) in out
    assert f"complexbody  {cb.__version__}" in out


def test_info_says_how_to_install(call, monkeypatch):
    def no_gl():
        raise errors.MissingPackage("VTK cannot draw here. Run: apt-get install libosmesa6")

    def no_compiler():
        raise errors.MissingPackage("No C compiler. Install one: apt install gcc.")

    monkeypatch.setattr(machine, "require_vtk", no_gl)
    monkeypatch.setattr(native, "compiler", no_compiler)
    monkeypatch.setattr(machine.importlib.util, "find_spec", lambda name: None)
    code, out, _ = call("info")
    assert code == 0
    for words in ("python3-slepc4py", "python3-gmsh", "python3-h5py", "libosmesa6", "install gcc"):
        assert words in out


def test_help(call):
    code, out, err = call("--help")
    assert (code, err) == (0, "")
    for words in ("examples:", "mpirun -n 4 complexbody run", "exit codes:", "def scene(comm"):
        assert words in out
    for number in ("0  done", "1  ", "2  ", "3  ", "4    ", "5    ", "130  ", "143  "):
        assert number in out
    assert call() == (0, out, "")
    assert call("--version") == (0, f"complexbody {cb.__version__}\n", "")
    for command in OPTIONS:
        assert re.search(rf"^    {command}\s", out, re.M)


@pytest.mark.parametrize("command", OPTIONS)
def test_help_has_every_option(call, command):
    code, out, _ = call(command, "--help")
    assert code == 0
    shown = {word.strip(",") for line in out.splitlines() for word in line.split()[:3]}
    for option in OPTIONS[command].split():
        assert option in shown
    assert all(len(line) <= 100 for line in out.splitlines())


@pytest.mark.parametrize(
    ("value", "words"),
    [(0.03125, "0.0312 s"), (12.34, "12.3 s"), (250.0, "4 min 10 s"), (7500.0, "2 h 5 min")],
)
def test_seconds_in_words(value, words):
    assert report.seconds(value) == words


def test_only_the_first_signal_counts(comm):
    with pytest.raises(together.Interrupted) as stop, together.signals(comm):
        try:
            signal.raise_signal(signal.SIGINT)
        finally:
            signal.raise_signal(signal.SIGTERM)
    assert stop.value.exit_code == 130
    assert not [t for t in threading.enumerate() if isinstance(t, threading.Timer) and t.is_alive()]


# --- real processes ----------------------------------------------------------------------------


def _started(*words, ranks=0, **more):
    """A process of the command line, or of ``ranks`` under mpirun."""
    # As root, and with more ranks than cores. The whole environment is given: that which MPI has
    # changed since in this process would keep mpirun from starting (Open MPI 4).
    extra = {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
    mpirun = ["mpirun", "--oversubscribe", "--bind-to", "none", "-n", str(ranks)] if ranks else []
    return subprocess.Popen(
        [*mpirun, sys.executable, *(str(word) for word in words)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **more,
        env={**os.environ, **extra},
    )  # fmt: skip


def _ended(process, timeout=90):
    try:
        out, err = process.communicate(timeout=timeout)
    except subprocess.TimeoutExpired:
        process.terminate()
        out, err = process.communicate()
        pytest.fail(f"it hangs:\n{out}\n{err}")
    return process.returncode, out, err


@pytest.mark.serial
@pytest.mark.parametrize("ranks", [0, 2])
def test_processes(bar, shared_path, ranks):
    path, out = bar(CHECK, PICTURE), shared_path / "out"
    words = ("-m", "complexbody", "run", path, "--out", out)
    code, text, err = _ended(_started(*words, ranks=ranks))
    assert code == 0, err
    assert text.count("check ") == 1
    assert "it/s" not in err  # no progress where there is no terminal
    assert record(out)["ranks"] == max(ranks, 1)
    assert record(out)["state"] == "finished"
    code, _, err = _ended(_started(*words, "--step", "1", ranks=ranks))
    assert code == 2
    assert err.count("complexbody: error: ") == 1
    assert err.count("Traceback") == 0


@pytest.mark.serial
def test_the_console_script_is_main():
    from importlib.metadata import entry_points

    script = [e for e in entry_points(group="console_scripts") if e.name == "complexbody"]
    assert script[0].load() is main


@pytest.mark.serial
def test_sigterm_of_a_process(bar, shared_path):
    path, out = bar(), shared_path / "out"
    words = ("run", path, "--until", "1e5", "--every", "1", "--out", out)
    process = _started("-m", "complexbody", *words)
    deadline = time.monotonic() + 60
    while not (out / "run.json").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    code, _, err = _ended(process)
    assert code == 143
    assert "stopped by SIGTERM" in err
    assert record(out)["state"] == "stopped by SIGTERM"


@pytest.mark.serial
def test_a_rank_that_waits_for_ever_is_stopped(shared_path):
    script = shared_path / "wait.py"
    script.write_text(
        textwrap.dedent("""
        from mpi4py import MPI
        from complexbody.errors import DivergenceError
        from complexbody.together import together

        ranks = MPI.COMM_WORLD.Dup()
        with together(ranks, patience=0.5):
            if ranks.rank == 1:
                raise DivergenceError("Too far. Turn back.")
            MPI.COMM_WORLD.Barrier()
        """)
    )
    code, _, err = _ended(_started(script, ranks=2))
    assert code == 4
    assert "complexbody: error: Too far. Turn back. (rank 1). The other ranks did not" in err
