# SPDX-License-Identifier: LGPL-3.0-or-later
"""Pictures of a run from its folder: what is read, what is drawn, and what is said if it cannot."""

from __future__ import annotations

import itertools
import json
import shutil

import numpy as np
import pytest
from dolfinx import fem, io
from mpi4py import MPI
from scipy.spatial import cKDTree
from written import body, domain, fields, wavy

import complexbody as cb
from complexbody import _compat, movie, picture
from complexbody.action import Action
from complexbody.cli import main
from complexbody.errors import MissingPackage, ResultsError
from complexbody.forms import isotropic_two_field
from complexbody.output import Output, Writer
from complexbody.reading import Results, table
from complexbody.reel import Reel
from complexbody.scales import stamps
from complexbody.show import show
from complexbody.surface import Surface

mpl = pytest.importorskip("matplotlib")
pytest.importorskip("matplotlib.image")
pytest.importorskip("pyvista")
h5py = pytest.importorskip("h5py")
SMALL = cb.Look(size=(400, 300))


def run(comm, folder, dim, **more):
    """A body that rings, with all its fields in the folder."""
    scene = cb.Scene(
        domain(comm, dim),
        isotropic_two_field(d=dim, viscosity=0.1),
        supports=[cb.Fix("u", where=lambda x: x[0] < 1e-9)],
        initial=cb.Initial(u=lambda x: 0.01 * np.array([np.sin(x[0]), x[0], x[0] ** 2])[:dim]),
        name="ringing",
    )
    names = ("u", "nu", "stress")
    output = Output(folder, every=0.25, fields=names, probes={"p": (0.6, 0.3, 0.2)[:dim]}, **more)
    return cb.simulate(scene, until=0.5, output=output)


def written(comm, folder, dim, value, times, cells=None):
    """A folder with u and ν at times: components value(x, i, time)."""
    scene = cb.Scene(domain(comm, dim, cells), body(3, 1))
    with Writer(Action(scene), Output(folder, fields=("u", "nu"))) as writer:
        for time in times:
            writer.write(time, fields(scene, lambda x, i, t=time: value(x, i, t) + 0 * x[0]))
    comm.barrier()


def pixels(path):
    return mpl.image.imread(path)[:, :, :3]


def positions(image, name):
    """Where on a colour map each pixel is, from 0 to 1, and how far its colour is from the map."""
    distance, nearest = cKDTree(mpl.colormaps[name](np.linspace(0, 1, 256))[:, :3]).query(image)
    return nearest / 255, distance


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_all_is_there_and_drawn_on_any_ranks(comm, shared_path, dim):
    """Values read are the run's own; without options there is a picture of everything."""
    folder = shared_path / "run"
    result = run(comm, folder, dim)
    nodes = _compat.node_map(result.scene.mesh).size_local
    for name in ("u", "nu"):
        function = getattr(result, name)
        mine = function.x.array.reshape(-1, function.function_space.dofmap.index_map_bs)[:nodes]
        points = comm.gather(result.scene.mesh.geometry.x[:nodes])
        values = comm.gather(mine)
        if comm.rank == 0:
            series = Results(folder).series(name)
            distance, place = cKDTree(series.points).query(np.concatenate(points))
            assert distance.max() < 1e-14 and len(np.unique(place)) == len(series.points)
            found, expected = series.values(-1)[place], np.concatenate(values)
            np.testing.assert_allclose(found[:, : expected.shape[1]], expected, rtol=0, atol=1e-15)
            np.testing.assert_allclose(series.times, [0, 0.25, 0.5], atol=1e-12)
    if comm.rank == 0:
        ledger = Results(folder).ledger()
        np.testing.assert_array_equal(ledger["stored"], result.ledger["stored"])
        probe = Results(folder).probes()["p"]
        np.testing.assert_array_equal(probe["nu1"], result.probes["p"]["nu"][:, 0])
    comm.barrier()
    made = show(folder, look=SMALL, comm=comm)
    names = ["u", "nu", "stress", "sheet", "ledger", "probes"]
    assert [path.name for path in made] == [f"{name}.png" for name in names]
    assert {path.parent for path in made} == {folder / "show"}
    for path in made:
        assert pixels(path).std() > 0.03, path
    assert pixels(made[0]).shape == (300, 400, 3)
    comm.barrier()


def test_the_ledger_has_its_curves(comm, shared_path):
    """Each energy in its colour, the total in black; units only if they are wanted."""
    run(comm, shared_path / "run", 1)
    [path] = show(shared_path / "run", parts="ledger", comm=comm)
    image = (255 * pixels(path)).round().astype(int)
    for colour in ((0, 114, 178), (86, 180, 233), (0, 158, 115), (213, 94, 0), (0, 0, 0)):
        assert (np.abs(image - colour).max(axis=2) <= 1).sum() > 50, colour
    comm.barrier()
    show(shared_path / "run", parts="ledger", look=cb.Look(units=False), comm=comm)
    assert (pixels(path) != image / 255).any()


def test_colours_of_all_times_are_the_same(comm, shared_path):
    """u₁ = t everywhere, at t = 0.25, 0.5 and 1: at 62, 75 and 100 % of one symmetric map."""
    def value(x, i, t):
        return t * (i == 0)

    written(comm, shared_path, 2, value, (0.25, 0.5, 1.0), cells=40)
    look = cb.Look(components=[0], warp=0, size=(400, 300))
    made = show(shared_path, "u", every=1, look=look, comm=comm)
    assert [path.name for path in made] == ["u-0000.png", "u-0001.png", "u-0002.png"]
    for path, expected in zip(made, (0.625, 0.75, 1.0), strict=True):
        place, distance = positions(pixels(path), "coolwarm")
        middle = place[130:170, 130:170]
        assert np.abs(middle - expected).max() < 0.01
        assert distance[130:170, 130:170].max() < 0.01
    # Given limits take the place of those; a later time alone has its own.
    comm.barrier()
    look = cb.Look(components=[0], warp=0, size=(400, 300), limits=(-2.0, 2.0))
    [path] = show(shared_path, "u", times=0.9, look=look, comm=comm)
    assert np.abs(positions(pixels(path), "coolwarm")[0][130:170, 130:170] - 0.75).max() < 0.01
    comm.barrier()


def test_limits_and_components(comm, shared_path):
    """A percentage leaves a spike out; one component that moves is shown with its sign."""
    def value(x, i, t):
        return np.where((x[0] > 1 - 1e-9) & (x[1] > 1 - 1e-9), 100.0, -1.0) * (i == 2)

    written(comm, shared_path, 2, value, (0.0, 1.0), cells=10)
    if comm.rank > 0:
        return
    results = Results(shared_path)
    [panel] = Reel(results, "u", None, cb.Look()).panels
    assert (panel.component, panel.limits, panel.beyond) == (2, (-100.0, 100.0), False)
    [panel] = Reel(results, "u", None, cb.Look(limits=95.0)).panels
    assert (panel.limits, panel.beyond) == ((-1.0, 1.0), True)
    norm, third = Reel(results, "u", None, cb.Look(["norm", 2])).panels
    assert norm.limits == (0.0, 100.0) and third.limits == (-100.0, 100.0)
    assert Reel(results, "nu", None, cb.Look()).panels[0].limits is None


@pytest.mark.parametrize("kind", ["gif", "mp4"])
@pytest.mark.parametrize("dim", [1, 2])
def test_films(comm, shared_path, kind, dim):
    """As many pictures as steps, which differ, in a frame that stays."""
    if kind == "mp4" and movie.ffmpeg() is None:
        pytest.skip("no ffmpeg")
    written(comm, shared_path, dim, lambda x, i, t: np.sin(x[0] + t + i), np.arange(5) / 5)
    [path] = show(shared_path, "u", animate=kind, fps=10, look=SMALL, comm=comm)
    if comm.rank > 0:
        return
    assert not list(path.parent.glob("*.part*"))
    if kind == "gif":
        from PIL import Image

        with Image.open(path) as film:
            assert (film.n_frames, film.size, film.info["duration"]) == (5, (400, 300), 100)
            frames = []
            for number in range(5):
                film.seek(number)
                frames.append(np.asarray(film.convert("RGB"), dtype=int))
        for one, next_ in itertools.pairwise(frames):
            changed = np.abs(one - next_).max(axis=2) > 100
            assert changed.sum() > (50 if dim == 1 else 0) and changed.mean() < 0.2
    else:
        imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
        assert imageio_ffmpeg.count_frames_and_secs(str(path)) == (5, pytest.approx(0.5))


def test_a_run_that_goes_on(comm, shared_path):
    """Between two steps of a run on all ranks its folder is shown, and once more later."""
    scene = cb.Scene(domain(comm, 2), body(3, 1))
    with Writer(Action(scene), Output(shared_path, fields=("u",))) as writer:
        for number in range(3):
            writer.write(float(number), fields(scene, lambda x, i, n=number: wavy(x, i) * n))
            made = show(shared_path, every=1, look=SMALL, comm=comm)
            assert [path.name for path in made] == (
                ["u.png"] if number == 0 else [f"u-{n:04d}.png" for n in range(number + 1)]
            )
            comm.barrier()


@pytest.mark.serial
def test_what_is_not_complete_is_left_out(comm, tmp_path):
    """An index that is cut off, a step whose values are missing, a row without its end."""
    written(comm, tmp_path, 1, lambda x, i, t: t + x[0], (0.0, 1.0, 2.0))
    index, data = tmp_path / "u.xdmf", tmp_path / "u.h5"
    whole = index.read_text()
    index.write_text(whole[: whole.rindex("/Function/u/2") + 5])
    np.testing.assert_array_equal(Results(tmp_path).series("u").times, [0, 1])
    index.write_text(whole)
    with h5py.File(data, "a") as file:
        del file["Function/u/2"]
    with pytest.warns(UserWarning, match="after t = 1 s is incomplete"):
        series = Results(tmp_path).series("u")
    assert series.times.tolist() == [0, 1]
    np.testing.assert_allclose(series.values(-1)[:, 0], 1 + series.points[:, 0], atol=1e-15)
    (tmp_path / "ledger.csv").write_text("time [s],stored [J]\n0.0,1.0\n0.5,2.0\n1.0,12.3")
    columns, units = table(tmp_path / "ledger.csv")
    assert columns["time"].tolist() == [0, 0.5] and columns["stored"].tolist() == [1, 2]
    assert units == {"time": "s", "stored": "J"}
    data.write_bytes(data.read_bytes()[:1000])
    with pytest.raises(ResultsError, match="cannot be read"):
        Results(tmp_path).series("u")


@pytest.mark.serial
def test_steps_in_several_files(comm, tmp_path):
    """Steps that stand in files of their own are those of one field."""
    written(comm, tmp_path, 2, lambda x, i, t: wavy(x, i) + t, (0.0, 1.0, 2.0))
    expected = [Results(tmp_path).series("u").values(i) for i in range(3)]
    shutil.copy(tmp_path / "u.h5", tmp_path / "u-1.h5")
    with h5py.File(tmp_path / "u.h5", "a") as file:
        del file["Function/u/2"]
    text = (tmp_path / "u.xdmf").read_text()
    (tmp_path / "u.xdmf").write_text(text.replace("u.h5:/Function/u/2", "u-1.h5:/Function/u/2"))
    series = Results(tmp_path).series("u")
    for number in range(3):
        np.testing.assert_array_equal(series.values(number), expected[number])


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_files_of_dolfinx_are_read_on_ranks(comm, shared_path, dim):
    """Its mesh stands apart from the steps."""
    mesh = domain(comm, dim)
    space = _compat.vector_space(mesh, 1)
    f = fem.Function(space)
    f.name = "temperature"
    with io.XDMFFile(comm, str(shared_path / "made.xdmf"), "w") as file:
        file.write_mesh(mesh)
        for time in (0.0, 0.5, 1.5):
            f.interpolate(lambda x, t=time: (wavy(x, 0) + t)[None])
            file.write_function(f, time)
    comm.barrier()
    if comm.rank > 0:
        return
    results = Results(shared_path)
    [name] = results.names
    series = results.series(name)
    assert series.dim == dim and not series.cellwise
    assert len(series.cells) == _compat.cell_count(domain(MPI.COMM_SELF, dim))[0]
    assert series.times.tolist() == [0.0, 0.5, 1.5]
    for number, time in enumerate(series.times):
        values = series.values(number)[:, 0]
        np.testing.assert_allclose(values, wavy(series.points.T, 0) + time, atol=1e-12)


def test_a_solid_is_cut_open():
    """The rest has its volume; P1 values on the plane are those of a linear field."""
    cube = domain(MPI.COMM_SELF, 3, 4)
    points, cells = cube.geometry.x, _compat.cell_nodes(cube)
    x = points @ [1.0, 2.0, 3.0]
    box = np.concatenate([points[cells].min(axis=1), points[cells].max(axis=1)], axis=1)
    for clip, eye, volume in (
        (None, None, 1.0), ((0, 0.3), (1.0, 0, 0), 0.3), ((0, 0.3), (-1.0, 0, 0), 0.7),
        ((1, 0.5), None, 0.5), ((2, 0.9), None, 0.9),
    ):  # fmt: skip
        surface = Surface(points, cells.astype(np.int64), clip, eye)
        seen = surface.see({"x": (x[:, None], False), "box": (box, True)})
        a, b, c = np.moveaxis(seen.points[seen.faces], 1, 0)
        assert np.einsum("fi,fi->", np.cross(b - a, c - a), a) / 6 == pytest.approx(volume)
        np.testing.assert_allclose(seen.values["x"][:, 0], seen.points @ [1.0, 2.0, 3.0])
        low, high = np.split(seen.values["box"], 2, axis=1)
        assert (low - 1e-9 <= (a + b + c) / 3).all() and ((a + b + c) / 3 <= high + 1e-9).all()
        assert (high - low).max() < 0.3
    with pytest.raises(ResultsError, match="between 0 and 1 m"):
        Surface(points, cells.astype(np.int64), (0, -2.0), (1.0, 0, 0))


def test_stamps_have_the_same_form():
    """No more digits than tell times apart."""
    assert stamps([0.0, 5e-7, 1e-6]) == ["t = 0.0 µs", "t = 0.5 µs", "t = 1.0 µs"]
    assert stamps([2.0]) == ["t = 2 s"] and stamps([0.0]) == ["t = 0 s"]
    assert stamps([0.0, 0.1, 0.30000000000000004], "") == ["t = 0.0", "t = 0.1", "t = 0.3"]


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"fields": "phi"}, "no field 'phi'. There are u, nu"),
        ({"times": 7.0}, "Give a time from 0 to 1 s"),
        ({"times": [], "fields": "u"}, "finite times"),
        ({"times": 0.5, "every": 2}, "exclude each other"),
        ({"every": 0}, "whole number from 1"),
        ({"animate": "avi"}, "no film of kind 'avi'"),
        ({"fps": 0.0}, "pictures per second"),
        ({"parts": "sheets"}, "no part 'sheets'"),
        ({"parts": "ledger"}, "no .*ledger.csv"),
        ({"parts": "probes"}, "no record of a probe"),
        ({"look": {"components": [3]}, "fields": "u"}, "no component 3. Give 'norm', or .* 0 to 2"),
        ({"look": {"clip": ("x", 0.5)}}, "they are for solids"),
        ({"look": {"clip": ("r", 0.5)}}, "an axis and a coordinate"),
        ({"look": {"view": "above"}}, "Give aslant, x"),
        ({"look": {"view": (0, 0, 0)}}, "three numbers"),
        ({"look": {"limits": (1.0, 1.0)}}, "two rising numbers"),
        ({"look": {"limits": 101.0}}, "a percentage"),
        ({"look": {"colours": "mud"}}, "no colour map 'mud'"),
        ({"look": {"warp": -1.0}}, "a factor ≥ 0"),
        ({"look": {"size": (10, 10)}}, "from 160 to 8000"),
    ],
)  # fmt: skip
def test_what_cannot_be_shown_on_any_rank(comm, shared_path, given, says):
    written(comm, shared_path, 1, lambda x, i, t: t, (0.0, 1.0))
    with pytest.raises(ResultsError, match=says):
        show(shared_path, comm=comm, **{**given, "look": cb.Look(**given.get("look", {}))})


def test_folders_without_results_on_any_rank(comm, shared_path):
    with pytest.raises(ResultsError, match="no folder"):
        show(shared_path / "none", comm=comm)
    with pytest.raises(ResultsError, match="no results"):
        show(shared_path, comm=comm)
    if comm.rank == 0:
        (shared_path / "ledger.csv").write_text("time [s],stored [J]\n")
    comm.barrier()
    with pytest.raises(ResultsError, match="no row yet"):
        show(shared_path, parts="ledger", comm=comm)
    with pytest.raises(ResultsError, match="no fields"):
        show(shared_path, parts="fields", comm=comm)


def test_missing_packages_on_any_rank(comm, shared_path, monkeypatch):
    """Without ffmpeg mp4 is refused with what to install, and "auto" is a gif."""
    written(comm, shared_path, 1, lambda x, i, t: t, (0.0, 1.0))
    monkeypatch.setattr(movie, "ffmpeg", lambda: None)
    with pytest.raises(MissingPackage, match="pip install imageio-ffmpeg"):
        show(shared_path, animate="mp4", comm=comm)
    [path] = show(shared_path, "nu", animate="auto", look=SMALL, comm=comm)
    assert path.name == "nu.gif"
    monkeypatch.setattr(picture, "find_spec", lambda name: None)
    with pytest.raises(MissingPackage, match="pip install matplotlib"):
        show(shared_path, comm=comm)


def test_the_command_on_any_rank(comm, shared_path, capsys):
    """It names its files; what is wrong ends it with code 2."""
    run(comm, shared_path, 1)
    if comm.rank == 0:
        record = {"scene": "my bar", "settings": {"probes": {"p": [0.6]}}}
        (shared_path / "run.json").write_text(json.dumps(record))
    comm.barrier()
    out = shared_path / "pictures"
    options = ["--component", "norm", "--clim=0,0.02", "--size", "400x300", "--out", str(out)]
    assert main(["show", str(shared_path), "--field", "u,stress", "--time", "0.3", *options]) == 0
    printed = capsys.readouterr().out
    if comm.rank == 0:
        assert [line.split()[0] for line in printed.splitlines()] == [
            str(out / "u.png"), str(out / "stress.png")
        ]  # fmt: skip
        assert "t = 250 ms, colours 0 to 0.02 m" in printed
        assert pixels(out / "u.png").shape == (300, 400, 3)
    assert main(["show", str(shared_path), "--ledger", "--probes", "--quiet"]) == 0
    assert capsys.readouterr().out == ""
    assert {path.name for path in (shared_path / "show").iterdir()} == {"ledger.png", "probes.png"}
    comm.barrier()
    for wrong in (["--clim", "1"], ["--size", "big"], ["--field", "phi"], ["--view", "1,x,2"]):
        assert main(["show", str(shared_path), *wrong]) == 2
    assert (comm.rank > 0) == (capsys.readouterr().err == "")
