# SPDX-License-Identifier: LGPL-3.0-or-later
"""Axes along which nothing varies: found where they are, not where they almost are."""

import numpy as np
import pytest
import ufl
from harness import everywhere, largest

import complexbody as cb
from complexbody import meshes
from complexbody.invariance import invariant_axes
from complexbody.problem import Problem


def elastic(U, nu, N):
    """Isotropic u, with ν following its first component."""
    strain = ufl.sym(U)
    return (0.5 * ufl.tr(strain) ** 2 + ufl.inner(strain, strain) + 0.5 * ufl.inner(N, N)
            + 0.5 * nu[0] ** 2 + 0.3 * ufl.inner(N[0, :], strain[0, :]))  # fmt: skip


BODY = cb.Body(1, elastic, 1.0, 1.0)
ENDS = lambda x: (x[2] < 1e-9) | (x[2] > 0.5 - 1e-9)  # noqa: E731
SIDE = lambda x: x[0] < 1e-9  # noqa: E731
SLIDING = cb.Fix("u", ENDS, components=2)


def wave(*directions):
    """u along some axes, even along z."""
    return lambda x: np.stack([np.sin(2 * x[0] + x[1]) if i in directions else 0 * x[0]
                               for i in range(3)])  # fmt: skip


def box(comm, body=BODY, cells=(3, 3, 2), **more):
    """A box 1 × 1 × ½."""
    mesh = meshes.box(comm, (0, 0, 0), (1, 1, 0.5), cells)
    return cb.Scene(mesh, body, **more)


def found(scene):
    axes = invariant_axes(Problem(scene, reduce=True))
    assert everywhere(scene.mesh.comm, axes == scene.mesh.comm.bcast(axes))
    return axes


PLANE = {"initial": cb.Initial(u=wave(0, 1)), "supports": [SLIDING]}


@pytest.mark.parametrize(
    "more, axes",
    [
        (PLANE, [2]),
        ({**PLANE, "supports": [SLIDING, cb.Fix("u", SIDE), cb.Fix("nu", SIDE)]}, [2]),
        ({**PLANE, "loads": [cb.Traction(SIDE, (1.0, 0.0, 0.0), cb.ricker(1.0))]}, [2]),
        ({**PLANE, "loads": [cb.BodyForce(lambda x: np.stack([x[1], x[0], 0 * x[0]]))]}, [2]),
        ({"initial": cb.Initial(nu=lambda x: x[0])}, []),
        # Almost: ends free where waves in the plane pull at them, or held where they slide.
        ({"initial": cb.Initial(u=wave(0, 1))}, []),
        ({**PLANE, "supports": [cb.Fix("u", ENDS)]}, []),
        ({**PLANE, "supports": [cb.Fix("u", lambda x: x[2] < 1e-9, components=2)]}, []),
        ({**PLANE, "initial": cb.Initial(u=lambda x: 1e-13 * x[2] + wave(0, 1)(x))}, []),
        ({**PLANE, "initial": cb.Initial(u=wave(0, 1, 2))}, []),
        ({**PLANE, "loads": [cb.BodyForce((0, 0, 1.0))]}, []),
        ({**PLANE, "loads": [cb.Traction(lambda x: SIDE(x) & (x[2] < 0.3), (1.0, 0, 0))]}, []),
        ({**PLANE, "supports": [SLIDING, cb.Fix("u", lambda x: SIDE(x) & (x[2] < 0.1))]}, []),
    ],
)
def test_axes(comm, more, axes):
    assert found(box(comm, **more)) == axes


def test_bodies_that_are_no_prisms(comm):
    """A wedge, and energies or data that cannot be looked at."""
    scene = box(comm, **PLANE)
    scene.mesh.geometry.x[:, 0] *= 1 + 0.3 * scene.mesh.geometry.x[:, 2]
    assert found(scene) == []
    for term in (
        lambda U, N: 0.1 * (U[0, 2] + U[2, 0]) * U[0, 0], lambda U, N: U[0, 0] ** 4,
        lambda U, N: 0.1 * N[0, 2],
    ):  # fmt: skip
        body = cb.Body(1, lambda U, nu, N, t=term: elastic(U, nu, N) + t(U, N), 1.0, 1.0)
        assert found(box(comm, body, **PLANE)) == []


@pytest.mark.serial
def test_the_cross_section_gives_the_same(comm):
    """Space and plane tend to each other as cells shrink: their difference is the meshes'."""
    start = cb.Initial(u=lambda x: np.stack([np.sin(np.pi * x[0]) * np.cos(np.pi * x[1]), 0 * x[0],
                                             0 * x[0]]))  # fmt: skip
    apart = []
    for n in (8, 16):
        space = box(comm, cells=(n, n, n // 4), initial=start, supports=[SLIDING])
        plane = cb.Scene(meshes.rectangle(comm, (0, 0), (1, 1), (n, n)), BODY, initial=start)
        assert found(space) == [2]
        probes = {"p": (0.5, 0.25)}
        values = []
        for scene, z in ((space, (0.25,)), (plane, ())):
            result = cb.simulate(scene, cb.Synchronous(0.3 / n), until=0.3)
            values.append(at(result, (*probes["p"], *z)))
        apart.append(np.abs(values[0] - values[1]).max())
    assert apart[1] < 0.4 * apart[0] and largest(comm, values[1]) > 0.05


def at(result, point):
    """(u, ν) at a node of the mesh."""
    x = result.scene.mesh.geometry.x
    node = int(np.argmin(np.linalg.norm(x[:, : len(point)] - point, axis=1)))
    return np.append(result.u.x.array.reshape(-1, 3)[node], result.nu.x.array[node])
