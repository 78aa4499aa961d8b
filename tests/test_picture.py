# SPDX-License-Identifier: LGPL-3.0-or-later
"""Pictures: what is seen, in which colours, and that any number of ranks draws the same."""

from __future__ import annotations

import numpy as np
import pytest
from dolfinx import fem
from mpi4py import MPI
from scipy.spatial import cKDTree
from written import domain

from complexbody import _compat, picture, rendering
from complexbody.drawing import displacement, factor_of
from complexbody.errors import MissingPackage, OutputError
from complexbody.picture import Panel, still
from complexbody.scales import Shown, Visible, prefixed

mpl = pytest.importorskip("matplotlib")
pytest.importorskip("pyvista")


def function(where, count, value):
    """A blocked P1 function."""
    made = fem.Function(_compat.vector_space(where, count))
    made.interpolate(lambda x: np.array([v + 0 * x[0] for v in value(x)]))
    return made


def waves(where):
    """A displacement, a descriptor with one component, and a field per cell."""
    cells = fem.Function(_compat.cell_space(where))
    cells.interpolate(lambda x: x[0])
    return {
        "u": function(where, 3, lambda x: (1e-3 * np.sin(6 * x[0]), 1e-3 * x[0] ** 2, 0 * x[0])),
        "nu": function(where, 1, lambda x: (np.cos(5 * x[0]),)),
        "stress": cells,
    }


def pixels(path):
    """The picture, shape (rows, columns, 3), from 0 to 1."""
    return mpl.image.imread(path)[:, :, :3]


def positions(image, name):
    """Where on a colour map each pixel is, from 0 to 1, and how far its colour is from the map."""
    colours = mpl.colormaps[name](np.linspace(0, 1, 256))[:, :3]
    distance, nearest = cKDTree(colours).query(image)
    return nearest / 255, distance


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_all_ranks_draw_what_one_draws(comm, shared_path, dim):
    """1600 pixels wide, not blank, and the same whatever the partition."""
    panels = (Panel("u"), Panel("nu"), Panel("stress", unit="Pa", label="$P_{11}$"))
    still(shared_path / "new" / "all.png", waves(domain(comm, dim)), panels, "Waves", 1.25e-5)
    if comm.rank > 0:
        return
    still(shared_path / "one.png", waves(domain(MPI.COMM_SELF, dim)), panels, "Waves", 1.25e-5)
    ours, alone = pixels(shared_path / "new" / "all.png"), pixels(shared_path / "one.png")
    assert ours.shape == alone.shape and ours.shape[1] == 1600
    assert (ours[:5] == 1).all() and (ours[:, :3] == 1).all()
    assert ours.std() > 0.05
    assert np.abs(ours - alone).mean() < 1e-3


@pytest.mark.parametrize("dim", [2, 3])
def test_colours_are_those_of_the_bar(comm, shared_path, dim):
    """|u| = 1 everywhere: a body in the top colour (exact if flat), and a bar with all of them."""
    where = domain(comm, dim, 30 if dim == 2 else 16)
    still(shared_path / "a.png", {"u": function(where, 2, lambda x: (0.6, -0.8))}, Panel(warp=None))
    if comm.rank > 0:
        return
    image = pixels(shared_path / "a.png")
    place, distance = positions(image, "viridis")
    yellow = (place > 0.9) & (distance < (0.01 if dim == 2 else 0.3))
    rows, columns = np.nonzero(yellow)
    body = columns < np.quantile(columns, 0.9)
    assert np.ptp(rows[body]) > 500 and np.ptp(columns[body]) > 500
    bar = (distance < 0.01).sum(axis=0) > 0.6 * len(image)
    bar &= np.array([len(set(column)) > 250 for column in place.T])
    [right] = np.nonzero(np.diff(bar.astype(int)) == 1)
    along = place[:, right + 5][distance[:, right + 5] < 0.01]
    assert along[0] > 0.97 and along[-1] < 0.03 and (np.diff(along) <= 1 / 255 + 1e-9).all()


def test_a_linear_field_has_linear_colours(comm, shared_path):
    """Blue where u₁ is negative, grey at zero, red where it is positive: the map is symmetric."""
    where = domain(comm, 2, 40)
    u = function(where, 2, lambda x: (4 * x[0] - 1, 0 * x[0]))
    still(shared_path / "a.png", {"u": u}, Panel("u", 0, warp=None))
    if comm.rank > 0:
        return
    place, distance = positions(pixels(shared_path / "a.png"), "coolwarm")
    row = place.shape[0] // 2
    [off] = np.nonzero(distance[row] > 0.03)
    first = np.diff(off).argmax()
    body = np.arange(off[first], off[first + 1])[3:-2]
    expected = 0.5 + np.linspace(-1, 3, 41) / 6  # from -1 to 3, on a map from -3 to 3
    found = place[row, np.linspace(body[0], body[-1], 41).astype(int)]
    np.testing.assert_allclose(found, expected, atol=0.01)


def test_the_surface_is_closed_and_looks_outwards(comm):
    """Of a cube: area 6, volume 1, each point once; values and cells belong to their places."""
    where = domain(comm, 3, 4)
    seen = picture._visible(where, waves(where))
    assert (seen is None) == (comm.rank > 0)
    if seen is None:
        return
    assert len(seen.faces) == 6 * 2 * 16 and len(seen.points) == 6 * 16 + 2
    a, b, c = np.moveaxis(seen.points[seen.faces], 1, 0)
    normal = np.cross(b - a, c - a) / 2
    assert np.linalg.norm(normal, axis=1).sum() == pytest.approx(6)
    assert np.einsum("fi,fi->", normal, a) / 3 == pytest.approx(1)
    np.testing.assert_allclose(seen.values["nu"][:, 0], np.cos(5 * seen.points[:, 0]))
    assert seen.cellwise == {"stress"}
    assert np.abs(seen.values["stress"][:, 0] - (a + b + c)[:, 0] / 3).max() < 0.25


@pytest.mark.parametrize("dim", [1, 2])
@pytest.mark.parametrize("value", [0.0, np.nan])
def test_nothing_to_see(comm, shared_path, dim, value):
    """Fields that vanish, or are not numbers, are drawn all the same."""
    where = domain(comm, dim)
    functions = {"u": function(where, 3, lambda x: (value,) * 3)}
    still(shared_path / "a.png", functions, (Panel(), Panel("u", 1)))
    if comm.rank == 0:
        assert pixels(shared_path / "a.png").std() > 0.02


def test_descriptor_alone(comm, shared_path):
    """Without u there is no deformation, and no need to say so."""
    where = domain(comm, 2)
    still(shared_path / "a.png", {"nu": function(where, 5, lambda x: (x[0],) * 5)}, Panel("nu"))
    if comm.rank == 0:
        assert pixels(shared_path / "a.png").std() > 0.05


def body(dim, u):
    """A body of size 1, or 10 in y, at four points."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 10, 0], [1, 10, 0]])
    return Visible(dim, points, np.array([[0, 1, 2]]), {"u": np.array(u) * np.ones((4, 1))}, set())


def test_deformation_is_visible_and_round():
    """6 % of the body, rounded down to 1, 2 or 5; to scale if that is near; none without motion."""
    for largest, factor in ((1e-6, 5e5), (2e-3, 200), (0.4, 1), (2.0, 1), (100.0, 0.005)):
        assert factor_of(body(2, [largest, 0.0, 0.0]), "u") == pytest.approx(factor)
    assert factor_of(body(2, [0.0, 0.0, 0.0]), "u") == 0
    # Antiplane motion: in the plane there is round-off.
    assert factor_of(body(2, [1e-12, 0.0, 1.0]), "u") == 0
    assert not displacement(body(2, [1.0]), "u", 1.0).any()
    np.testing.assert_array_equal(displacement(body(2, [1.0, 2.0, 3.0]), "u", 2.0)[0], [2, 4, 0])


def test_units_and_maps():
    """Prefixes bring numbers near 1 where a unit takes them; only signed fields have a middle."""
    assert prefixed(0.9e-6, "m") == (pytest.approx(1e-6), "µ")
    assert prefixed(0.02, "m/s") == (pytest.approx(1e-3), "m")
    assert prefixed(7e7, "Pa") == (pytest.approx(1e6), "M")
    assert prefixed(1e-30, "m")[1] == "p"
    for largest, unit in ((7e7, ""), (7e7, "m²"), (0.0, "m"), (np.inf, "m")):
        assert prefixed(largest, unit) == (1.0, "")
    seen = body(2, [3e-6, -4e-6])
    norm = Shown(Panel("u"), seen)
    assert (norm.label, norm.map) == ("$|u|$  [µm]", "viridis")
    assert norm.limits == pytest.approx((0, 5)) and norm.values == pytest.approx(5)
    second = Shown(Panel("u", 1, unit=""), seen)
    assert (second.label, second.map) == ("$u_{2}$", "coolwarm")
    assert second.limits == pytest.approx((-4e-6, 4e-6))
    assert Shown(Panel("u", 0, label="opening"), seen).label == "opening  [µm]"


@pytest.mark.parametrize(
    ("panels", "says"),
    [
        (Panel("phi"), "no field 'phi'"),
        (Panel("u", 3), "from 0 to 2"),
        (Panel("u", "x"), "from 0 to 2"),
        (Panel(warp="phi"), "warp='phi'"),
        ((), "nothing to show"),
    ],
)
def test_panels_that_show_nothing(comm, panels, says):
    with pytest.raises(OutputError, match=says):
        still("a.png", {"u": function(domain(comm, 1), 3, lambda x: (x[0],) * 3)}, panels)


def test_unwritable(comm, shared_path):
    """A file where the folder should be: all ranks say so."""
    if comm.rank == 0:
        (shared_path / "file").write_text("in the way")
    comm.barrier()
    with pytest.raises(OutputError, match="cannot be written"):
        still(shared_path / "file" / "a.png", waves(domain(comm, 1)), Panel())


def test_missing_packages(comm, shared_path, monkeypatch):
    """VTK crashes without a GL library; that, and what pip installs, is said by all ranks."""
    flat = waves(domain(comm, 2))
    rendering.require_vtk.cache_clear()
    with monkeypatch.context() as patch:
        patch.setattr(rendering, "_TRIAL", "import os, signal; os.kill(os.getpid(), 11)")
        with pytest.raises(MissingPackage, match="libosmesa6"):
            still(shared_path / "a.png", flat, Panel())
        patch.setattr(rendering, "find_spec", lambda name: None)
        with pytest.raises(MissingPackage, match="pip install pyvista"):
            still(shared_path / "a.png", flat, Panel())
        patch.setattr(picture, "find_spec", lambda name: None)
        with pytest.raises(MissingPackage, match="pip install matplotlib"):
            still(shared_path / "a.png", waves(domain(comm, 1)), Panel())
    still(shared_path / "a.png", flat, Panel())
