"""Scene files: what they may say, what the command line may change, and how errors are told."""

import pytest
from mpi4py import MPI

import complexbody as cb
from complexbody.errors import BodyError, CommandError, MissingPackage
from complexbody.scenefile import CheckFailed, SceneFile, assignments, points

BAR = '''"""A bar.

More about it.
"""
import complexbody as cb
from complexbody import meshes
from complexbody.forms import isotropic_two_field

def scene(comm, cells=8, k0=1.0, lumped=False, name=None):
    how = "lumped" if lumped else "consistent"
    return cb.Scene(meshes.interval(comm, 0.0, 1.0, cells), isotropic_two_field(d=1, k0=k0),
                    self_action=how, name=name or "bar")
'''


@pytest.fixture
def write(comm, shared_path):
    """A function that writes a scene file, once for all ranks, and returns its path."""

    def writer(text, name="bar.py"):
        comm.Barrier()  # nobody still reads the one before
        path = shared_path / name
        if comm.rank == 0:
            path.write_text(text, encoding="utf-8")
        comm.Barrier()
        return path

    return writer


def line_of(text, part):
    return 1 + next(i for i, line in enumerate(text.splitlines()) if part in line)


def test_reads_a_scene_file(write, comm):
    file = SceneFile(write(BAR))
    assert file.title == "A bar."
    assert file.defaults == {}
    assert file.parameters == {"cells": 8, "k0": 1.0, "lumped": False, "name": None}
    assert not file.has("check")
    assert not file.has("picture")
    scene = file.scene(comm, file.complete({"cells": 4}))
    assert isinstance(scene, cb.Scene)
    assert comm.allreduce(scene.mesh.topology.index_map(1).size_local) == 4


def test_reads_a_file_anew_and_leaves_nothing_beside_it(write):
    first = write("N = 1\ndef scene(comm): pass\n")
    assert SceneFile(first).module.N == 1
    second = write("N = 2\ndef scene(comm): pass\n")
    assert SceneFile(second).module.N == 2
    assert sorted(p.name for p in second.parent.iterdir()) == ["bar.py"]


def test_imports_from_its_own_folder_hide_nothing_that_is_installed(write):
    write("VALUE = 7\n", "helper_of_scenes.py")
    write("raise RuntimeError\n", "json.py")
    path = write("import json\nfrom helper_of_scenes import VALUE\ndef scene(comm): pass\n")
    assert SceneFile(path).module.VALUE == 7


@pytest.mark.parametrize(
    ("given", "name", "value"),
    [
        ({}, "cells", 8),
        ({"cells": 1e1}, "cells", 10),
        ({"k0": 2}, "k0", 2),
        ({"lumped": True}, "lumped", True),
        ({"name": "x"}, "name", "x"),
    ],
)
def test_parameters(write, given, name, value):
    found = SceneFile(write(BAR)).complete(given)[name]
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"sells": 3}, ("no parameter sells", "cells=8, k0=1.0, lumped=False, name=None")),
        ({"comm": 3}, ("no parameter comm",)),
        ({"cells": "many"}, ("cells is 'many'", "Give a number", "8")),
        ({"k0": True}, ("k0 is True", "Give a number")),
        ({"lumped": "yes"}, ("lumped is 'yes'", "Give True or False")),
    ],
)
def test_wrong_parameters(write, given, words):
    with pytest.raises(CommandError) as error:
        SceneFile(write(BAR)).complete(given)
    for word in words:
        assert word in str(error.value)


def test_parameters_without_default_are_needed(write):
    file = SceneFile(write("def scene(comm, cells, size=1.0): pass\n"))
    assert file.complete({"cells": 3}) == {"cells": 3, "size": 1.0}
    with pytest.raises(CommandError, match=r"needs cells\. Give --set cells=…\. .*cells, size=1"):
        file.complete({})


def test_any_parameter_may_be_taken(write):
    file = SceneFile(write("def scene(comm, size=1.0, **others): pass\n"))
    assert file.complete({"cells": 3}) == {"size": 1.0, "cells": 3}
    with pytest.raises(CommandError, match=r"no parameter cells\. It has no parameters"):
        SceneFile(write("def scene(comm): pass\n")).complete({"cells": 3})


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("x = 1\ndef scene(comm:\n", 2, ("SyntaxError",)),
        ("x = 1\n\nimport no_such_module\n", 3, ("ModuleNotFoundError", "no_such_module")),
        ("def f():\n    return 1 / 0\n\nf()\n", 2, ("ZeroDivisionError: division by zero",)),
        ("import sys\nsys.exit(3)\n", 2, ("SystemExit: 3",)),
    ],
)
def test_files_that_cannot_be_imported(write, text, line, words):
    path = write(text)
    with pytest.raises(CommandError) as error:
        SceneFile(path)
    for word in (f"{path}, line {line}", "Correct the scene file", *words):
        assert word in str(error.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x = 1\n", ("no function scene", "def scene(comm, **parameters)")),
        ("scene = 3\n", ("no function scene",)),
        ("def scene(): pass\n", ("takes no comm",)),
        ("DEFAULTS = 3\ndef scene(comm): pass\n", ("DEFAULTS is not a dict",)),
        (
            "DEFAULTS = dict(untill=3)\ndef scene(comm): pass\n",
            ("unknown untill", "until, every", "probe_steps"),
        ),
    ],
)
def test_files_that_are_no_scene_files(write, text, words):
    with pytest.raises(CommandError) as error:
        SceneFile(write(text))
    for word in words:
        assert word in str(error.value)


def test_files_that_cannot_be_read(shared_path):
    with pytest.raises(CommandError, match=r"nowhere\.py cannot be read \(No such file"):
        SceneFile(shared_path / "nowhere.py")
    with pytest.raises(CommandError, match=r"cannot be read \(Is a directory\)"):
        SceneFile(shared_path)


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("return 3", ("returned a int", "complexbody.Scene")),
        ("return None", ("returned None",)),
        ("return {}['a']", ("line 3, in scene()", "KeyError")),
        ("raise SystemExit", ("line 3, in scene()", "SystemExit")),
    ],
)
def test_scenes_that_are_none(write, comm, body, words):
    path = write(f"import complexbody as cb\ndef scene(comm):\n    {body}\n")
    with pytest.raises(CommandError) as error:
        SceneFile(path).scene(comm, {})
    for word in words:
        assert word in str(error.value)


def test_meshes_are_made_on_all_ranks(write, comm):
    file = SceneFile(write(BAR.replace("interval(comm", "interval(MPI.COMM_SELF")))
    file.module.MPI = MPI
    if comm.size == 1:
        file.scene(comm, {})
        return
    with pytest.raises(CommandError, match=rf"on 1 of {comm.size} ranks\. Make it with the comm"):
        file.scene(comm, {})


def test_errors_of_complexbody_keep_their_kind_and_gain_a_place(write, comm):
    path = write(BAR)
    line = line_of(BAR, "isotropic_two_field(d=1, k0=k0)")
    with pytest.raises(BodyError, match=rf"k0 >= 0.*\({path}, line {line}, in scene\(\)\)"):
        SceneFile(path).scene(comm, {"k0": -1.0})


def test_checks(write):
    text = """
from complexbody.errors import MissingPackage
def scene(comm): pass
def check(result):
    if result == "bare":
        assert result == 3
    assert result != "told", "it is wrong"
    if result == "missing":
        raise MissingPackage("There is no gmsh. Install it.")
    if result == "raises":
        return [][1]
    return result
"""
    path = write(text)
    file = SceneFile(path)
    assert file.check("good") == "good"
    assert file.check(None) == "passed"
    with pytest.raises(CheckFailed) as failure:
        file.check("told")
    assert str(failure.value) == f"Check failed ({path}, line 7): it is wrong"
    assert failure.value.exit_code == 5
    with pytest.raises(CheckFailed, match=r"line 6.*assertion failed: assert result == 3"):
        file.check("bare")
    with pytest.raises(CommandError, match=r"line 11, in check\(\): IndexError") as error:
        file.check("raises")
    assert not isinstance(error.value, CheckFailed)
    with pytest.raises(MissingPackage, match=r"no gmsh.*line 9, in check\(\)"):
        file.check("missing")


def test_pictures(write, shared_path):
    text = "def scene(comm): pass\ndef picture(result, path): result.append(path.name)\n"
    seen = []
    SceneFile(write(text)).picture(seen, shared_path / "a.png")
    assert seen == ["a.png"]
    with pytest.raises(CommandError, match=r"line 2, in picture\(\): AttributeError"):
        SceneFile(write(text)).picture(None, shared_path / "a.png")
    assert not SceneFile(write(text)).draws_with_vtk
    assert SceneFile(write("def scene(comm): import pyvista\n")).draws_with_vtk


def test_interruptions_pass(write):
    with pytest.raises(KeyboardInterrupt):
        SceneFile(write("raise KeyboardInterrupt\n"))


def test_assignments():
    texts = ["a=1", "b=1e-3", "c=(1, 2)", "d=True", "e=steel", "f='x y'", "g=", "h=a=b", " i = 2 "]
    assert assignments(texts) == {
        "a": 1, "b": 1e-3, "c": (1, 2), "d": True, "e": "steel", "f": "x y", "g": "", "h": "a=b",
        "i": 2,
    }  # fmt: skip


@pytest.mark.parametrize("text", ["a", "=1", "1a=2", "", "a b=1"])
def test_wrong_assignments(text):
    with pytest.raises(CommandError, match=r"not name=value\. Give"):
        assignments([text])


def test_points():
    assert points(["a=1,2.5,-3", "b=1e-3"]) == {"a": (1.0, 2.5, -3.0), "b": (1e-3,)}


@pytest.mark.parametrize("text", ["a", "a=", "a=1,x", "=1,2", "1,2"])
def test_wrong_points(text):
    with pytest.raises(CommandError, match=r"not name=x,y,z\. Give"):
        points([text])
