# SPDX-License-Identifier: LGPL-3.0-or-later
"""Probes: in which cell, whose, with which weights."""

from __future__ import annotations

import numpy as np
import pytest
from written import GRADIENT, body, domain

from complexbody import _compat
from complexbody.errors import SceneError
from complexbody.probes import Probes
from complexbody.scene import Scene


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_probes_are_exact_for_affine_fields(comm, dim):
    """Inside, on nodes and facets, in corners: each is one rank's, and rank 0 gets all in order."""
    scene = Scene(domain(comm, dim), body())
    rng = np.random.default_rng(3)
    inside = [*rng.uniform(size=(20, dim)), *scene.mesh.comm.bcast(scene.mesh.geometry.x[:5, :dim])]
    points = [*inside, np.zeros(dim), np.ones(dim), np.full(dim, 0.5), np.full(dim, 0.1 + 0.2)]
    probes = Probes(scene, {f"p{i}": point for i, point in enumerate(points)})
    owners = comm.allgather(probes.indices)
    assert sorted(np.concatenate(owners)) == list(range(len(points)))
    assert probes.cells_nodes.shape == probes.weights.shape == (len(probes.indices), dim + 1)
    np.testing.assert_allclose(probes.weights.sum(axis=1), 1.0)
    assert probes.weights.min(initial=0.0) > -1e-7
    x = scene.mesh.geometry.x
    values = np.column_stack([1 + x @ GRADIENT[0], 2 - x @ GRADIENT[1]])
    local = np.einsum("pa,pac->pc", probes.weights, values[probes.cells_nodes])
    found = probes.gather(local)
    assert (found is None) == (comm.rank > 0)
    if found is not None:
        where = np.array(points)
        expected = [1 + where @ GRADIENT[0, :dim], 2 - where @ GRADIENT[1, :dim]]
        np.testing.assert_allclose(found, np.column_stack(expected), atol=1e-13)


def test_a_point_shared_by_ranks_is_the_lowest_ones(comm):
    """The owner does not hang on round-off, nor do the weights on the origin."""
    scene = Scene(domain(comm, 2), body())
    nodes = np.unique(np.concatenate(comm.allgather(scene.mesh.geometry.x)).round(12), axis=0)
    probes = Probes(scene, {str(i): node[:2] for i, node in enumerate(nodes)})
    mine = scene.mesh.geometry.x[
        np.unique(_compat.cell_nodes(scene.mesh)[: _compat.cell_count(scene.mesh)[0]])
    ]
    touched = np.array(comm.allgather([np.abs(mine - node).sum(1).min() < 1e-9 for node in nodes]))
    np.testing.assert_array_equal(probes.indices, np.flatnonzero(touched.argmax(0) == comm.rank))


def test_probes_outside_are_named(comm):
    scene = Scene(domain(comm, 2), body())
    points = {"in": (0.5, 0.5), "far": (1.5, 0.5), "just": (0.5, 1.0 + 1e-6)}
    with pytest.raises(
        SceneError, match=r"'far' at \[1.5, 0.5\] \(nearest node: \[1.0, 0.5\]"
    ) as e:
        Probes(scene, points)
    assert "'just'" in str(e.value) and "'in'" not in str(e.value)
    with pytest.raises(SceneError, match="one coordinate for each"):
        Probes(scene, {"deep": (0.5, 0.5, 0.5)})
    none = Probes(scene, {})
    assert none.weights.shape == (0, 3)
