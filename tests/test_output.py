# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a run writes: fields as others read them, derived ones, and when."""

from __future__ import annotations

import math

import numpy as np
import pytest
import ufl
from dolfinx import mesh
from mpi4py import MPI
from written import GRADIENT, K0, K1, LAM, MU, body, domain, fields, read, wavy

from complexbody import _compat
from complexbody.action import Action
from complexbody.body import Body
from complexbody.errors import OutputError, SceneError
from complexbody.output import CELL_FIELDS, NODE_FIELDS, Output, Writer
from complexbody.scene import Scene


@pytest.mark.parametrize(("dim", "n_u", "k"), [(1, 1, 2), (2, 3, 1), (2, 2, 5), (3, 3, 3)])
def test_nodal_fields_are_read_back(comm, shared_path, dim, n_u, k):
    """Meshio and h5py find the nodal values, at their points, with zeros to fill vectors."""
    h5py = pytest.importorskip("h5py")
    scene = Scene(domain(comm, dim), body(n_u, k))
    times = [0.0, 0.1, 0.1 + 0.2]
    with Writer(Action(scene), Output(shared_path / "new" / "results")) as writer:
        for number, time in enumerate(times):
            writer.write(time, fields(scene, lambda x, i, n=number: (n + 1) * wavy(x, i)))
    comm.barrier()
    if comm.rank > 0:
        return
    whole = domain(MPI.COMM_SELF, dim)
    first = 0
    for name in NODE_FIELDS:
        count = n_u if name.startswith("u") else k
        index = shared_path / "new" / "results" / f"{name}.xdmf"
        points, cells, steps = read(index)
        assert len(points) == len(whole.geometry.x)
        assert cells.shape == (_compat.cell_count(whole)[0], dim + 1)
        corners = points[cells][:, :, :dim]
        volume = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])).sum()
        assert volume / math.factorial(dim) == pytest.approx(1.0)
        expected = np.array([wavy(points.T, i) for i in range(first, first + count)]).T
        assert [step[:2] for step in steps] == [(time, name) for time in times]
        with h5py.File(index.with_suffix(".h5")) as file:
            for number, (time, _, values) in enumerate(steps):
                assert values.shape[1] == (3 if count == 2 else count)
                np.testing.assert_allclose(values[:, :count], (number + 1) * expected, atol=1e-14)
                assert not values[:, count:].any()
                data = file[f"Function/{name}/{number}"]
                assert data.attrs["time"] == time
                np.testing.assert_array_equal(data, values)
        kind = {1: "Scalar", 2: "Vector", 3: "Vector"}.get(count, "Matrix")
        assert f'AttributeType="{kind}" Center="Node"' in index.read_text()
        first += count


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_files_do_not_depend_on_ranks(comm, shared_path, dim):
    """Every number is where a serial run puts it."""
    h5py = pytest.importorskip("h5py")
    # det F of these fields comes near zero: those divided by it are in test_derived.py.
    names = (*NODE_FIELDS, *(n for n in CELL_FIELDS if not n.startswith(("cauchy", "actual"))))
    for ranks, folder in ((comm, "all"), (MPI.COMM_SELF, f"alone-{comm.rank}")):
        scene = Scene(domain(ranks, dim), body())
        with Writer(Action(scene), Output(shared_path / folder, fields=names)) as writer:
            writer.write(0.5, fields(scene, wavy))
    comm.barrier()
    for name in names:
        with (
            h5py.File(shared_path / "all" / f"{name}.h5") as ours,
            h5py.File(shared_path / f"alone-{comm.rank}" / f"{name}.h5") as alone,
        ):
            for part in ("Mesh/mesh/topology", "Mesh/mesh/geometry"):
                np.testing.assert_array_equal(ours[part], alone[part])
            path = f"Function/{CELL_FIELDS.get(name, name)}/0"
            np.testing.assert_allclose(ours[path], alone[path], rtol=0, atol=1e-13)


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_stress_of_an_affine_displacement(comm, shared_path, dim):
    """P = λ tr ε I + 2με, z = k0 ν at the midpoint, S = k1 N and ρe, of affine fields."""
    scene = Scene(domain(comm, dim), body(3, 2))
    gradient = np.vstack([GRADIENT, 2 * GRADIENT[:2]])[:, :dim]

    def affine(x, i):
        return gradient[i % 5] @ x[:dim] + i

    names = ("stress", "self_action", "microstress", "energy_density")
    with Writer(Action(scene), Output(shared_path, fields=names)) as writer:
        writer.write(0.0, fields(scene, affine))
    comm.barrier()
    if comm.rank > 0:
        return
    U, N = np.zeros((3, 3)), np.zeros((2, 3))
    U[:, :dim], N[:, :dim] = gradient[:3], gradient[3:]
    e = (U + U.T) / 2
    P = LAM * np.trace(e) * np.eye(3) + 2 * MU * e
    found = {name: read(shared_path / f"{name}.xdmf") for name in names}
    points, cells, _ = found["stress"]
    nu = np.array([affine(points[cells].mean(axis=1).T, i) for i in (3, 4)]).T
    elastic = 0.5 * (P * U).sum() + 0.5 * K1 * (N * N).sum()
    expected = {
        "stress": np.tile(P.ravel(), (len(cells), 1)),
        "self_action": np.pad(K0 * nu, ((0, 0), (0, 1))),
        "microstress": np.tile(np.append(K1 * N.ravel(), [0, 0, 0]), (len(cells), 1)),
        "energy_density": elastic + 0.5 * K0 * (nu**2).sum(axis=1, keepdims=True),
    }
    kinds = dict(zip(names, ("Tensor", "Vector", "Tensor", "Scalar"), strict=True))
    for name in names:
        [(_, stored, values)] = found[name][2]
        assert stored == CELL_FIELDS[name]
        np.testing.assert_allclose(values, expected[name], atol=1e-12)
        text = (shared_path / f"{name}.xdmf").read_text()
        assert f'AttributeType="{kinds[name]}" Center="Cell"' in text


def test_stress_of_a_quartic_energy(comm, shared_path):
    """P = (U·U) U: the derivative is taken where the fields are, and one row stays a vector."""
    scene = Scene(domain(comm, 2), body(1, 1))
    with Writer(Action(scene), Output(shared_path, fields=["stress"])) as writer:
        writer.write(0.0, fields(scene, lambda x, i: 2 * x[0] - 3 * x[1]))
    comm.barrier()
    if comm.rank == 0:
        [(_, _, values)] = read(shared_path / "stress.xdmf")[2]
        np.testing.assert_allclose(values, 13 * np.tile([2, -3, 0], (len(values), 1)), atol=1e-12)


def test_fields_an_energy_does_not_know_are_zero(comm, shared_path):
    """No microstress without N in the energy; no stress, not even a self-action, without any."""
    for number, energy in enumerate((lambda U, nu, N: ufl.dot(nu, nu), lambda U, nu, N: 0.0)):
        scene = Scene(domain(comm, 2), Body(2, energy, density=1.0, inertia=1.0))
        output = Output(shared_path / str(number), fields=("self_action", "microstress"))
        with Writer(Action(scene), output) as writer:
            writer.write(0.0, fields(scene, wavy))
        comm.barrier()
        if comm.rank == 0:
            assert not read(output.folder / "microstress.xdmf")[2][0][2].any()
            assert read(output.folder / "self_action.xdmf")[2][0][2].any() == (number == 0)


def test_each_region_has_its_own_stress(comm, shared_path):
    """One cell, on one rank, of another stiffness: its stress is the other body's."""
    square = domain(comm, 2)
    cells = np.arange(_compat.cell_count(square)[0], dtype=np.int32)
    tags = np.where(_compat.original_cells(square)[: len(cells)] == 7, 5, 2).astype(np.int32)
    scene = Scene(
        square,
        {2: body(), 5: body(stiffness=10.0)},
        cell_tags=mesh.meshtags(square, 2, cells, tags),
    )
    with Writer(Action(scene), Output(shared_path, fields=["stress"])) as writer:
        writer.write(0.0, fields(scene, lambda x, i: GRADIENT[i % 3, :2] @ x[:2]))
    comm.barrier()
    if comm.rank == 0:
        [(_, _, values)] = read(shared_path / "stress.xdmf")[2]
        ratio = values[:, 0] / values[0, 0]
        expected = np.ones(len(ratio))
        expected[7] = 10.0
        np.testing.assert_allclose(ratio, expected)


def test_schedule():
    """From 0 to the end, both included, but not also a multiple that misses it by round-off."""
    output = Output("results", every=0.3)
    np.testing.assert_array_equal(output.schedule(1.0), [0, 0.3, 0.6, 0.3 * 3, 1.0])
    np.testing.assert_array_equal(Output("results", every=0.1).schedule(0.3), [0, 0.1, 0.2, 0.3])
    np.testing.assert_array_equal(output.schedule(0.2), [0, 0.2])
    assert len(Output("results", every=1e-7).schedule(2e-5)) == 201
    np.testing.assert_array_equal(Output("results").schedule(2.0), [0, 2.0])
    given = Output("results", times=(3.0, 0.5, 0.5, 7.0))
    np.testing.assert_array_equal(given.schedule(5.0), [0, 0.5, 3.0, 5.0])
    for until in (0.0, -1.0, math.nan, math.inf, "later"):
        with pytest.raises(OutputError, match="positive, finite"):
            output.schedule(until)
    with pytest.raises(OutputError, match="larger every"):
        Output("results", every=1e-12).schedule(1.0)


@pytest.mark.parametrize(
    ("wrong", "error", "says"),
    [
        ({"every": 0.0}, OutputError, "positive time"),
        ({"every": math.nan}, OutputError, "positive time"),
        ({"every": "1"}, OutputError, "positive time"),
        ({"every": 1.0, "times": (1.0,)}, OutputError, "exclude"),
        ({"times": (1.0, -1.0)}, OutputError, "times"),
        ({"fields": ("u", "strain")}, OutputError, "'strain' is not known"),
        ({"probe_steps": 0}, OutputError, "probe_steps"),
        ({"probe_steps": 1.5}, OutputError, "probe_steps"),
        ({"probes": {"a": (0.0, math.inf)}}, SceneError, "probe 'a'"),
        ({"probes": {"a": "here"}}, SceneError, "probe 'a'"),
        ({"probes": {"a": ()}}, SceneError, "probe 'a'"),
        ({"probes": {"a/b": (0.0,)}}, SceneError, "plain name"),
        ({"probes": [(0.0, 0.0)]}, SceneError, "mapping"),
    ],
)
def test_outputs_that_make_no_sense(wrong, error, says):
    with pytest.raises(error, match=says):
        Output("results", **wrong)


def test_a_mesh_larger_than_a_file_should_be(comm, shared_path, monkeypatch):
    """It stays in the first file, whatever the size of a step."""
    import meshio

    import complexbody as cb
    from complexbody import series
    from complexbody.forms import isotropic_two_field
    from complexbody.meshes import rectangle

    monkeypatch.setattr(series, "BYTES", 1)
    scene = cb.Scene(rectangle(comm, (0, 0), (1, 1), 4), isotropic_two_field(d=2))
    cb.simulate(scene, until=0.3, output=cb.Output(shared_path / "out", every=0.1))
    if comm.rank == 0:
        with meshio.xdmf.TimeSeriesReader(shared_path / "out" / "u.xdmf") as reader:
            points, _ = reader.read_points_cells()
            steps = [reader.read_data(i)[0] for i in range(reader.num_steps)]
        assert len(points) == 25
        np.testing.assert_allclose(steps, [0, 0.1, 0.2, 0.3], atol=1e-12)
