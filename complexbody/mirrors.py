# SPDX-License-Identifier: LGPL-3.0-or-later
"""Planes of symmetry as supports, and whether bodies look the same in such a mirror.

Knows what polar and axial vectors, scalars and tensors do in a mirror, and no time step.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from mpi4py import MPI

from complexbody import _compat
from complexbody.conditions import Symmetry
from complexbody.errors import SceneError, agree
from complexbody.facets import exterior
from complexbody.given import finite, short

if TYPE_CHECKING:
    from complexbody.problem import Problem
    from complexbody.scene import Scene

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[Any]

#: Change of an energy in the mirror, relative to its size, above which it is no symmetry.
TOLERANCE = 1e-9
AXES = "xyz"


def representation(parity: Any, mirror: Array, count: int, what: str) -> Array:
    """Matrix by which a mirror acts on a field of ``count`` components.

    Args:
        parity: As in :class:`complexbody.conditions.Symmetry`.
        mirror: Q = I − 2n⊗n, shape (3, 3).
        count: Number of components.
        what: The field, for messages.

    Raises:
        SceneError: if the parity is not known or does not fit.
    """
    if callable(parity):
        parity = parity(mirror)
    if not isinstance(parity, str):
        given = finite(parity)
        matrix = np.zeros(0) if given is None else np.atleast_2d(given)
        square = matrix.shape == (count, count)
        if not square or np.abs(matrix @ matrix - np.eye(count)).max(initial=0.0) > 1e-12:
            raise SceneError(
                f"Symmetry: the parity of {what} is no {count}×{count} matrix whose square is one. "
                "Give what the mirror does to its components."
            )
        return matrix
    made: Array | None = None
    if parity in ("even", "odd"):
        made = np.eye(count) * (1.0 if parity == "even" else -1.0)
    elif parity == "polar" and count <= 3:
        made = mirror[:count, :count]
    elif parity == "axial" and count in (1, 3):
        # Of one rotation in the plane: that about z.
        made = -mirror if count == 3 else -mirror[2:, 2:]
    elif parity == "tensor" and count in (1, 4, 9):
        d = round(np.sqrt(count))
        made = np.kron(mirror[:d, :d], mirror[:d, :d])
    if made is None:
        raise SceneError(
            f"Symmetry: {short(parity)} is no parity of the {count} components of {what}. Give "
            "'polar' (three at most), 'axial' (one or three), 'even', 'odd', 'tensor' (d²), "
            "or a matrix."
        )
    return made + 0.0


def mirror_plane(scene: Scene, symmetry: Symmetry, facets: Ints) -> int:
    """The coordinate axis that a plane of symmetry is perpendicular to; collective.

    Raises:
        SceneError: if the facets are in no such plane (on all ranks).
    """
    mesh = scene.mesh
    found = exterior(mesh, facets)
    least = np.abs(found.normals).min(axis=0, initial=1.0)
    mesh.comm.Allreduce(MPI.IN_PLACE, least, op=MPI.MIN)
    axis = int(np.argmax(least))
    error = None
    if least[axis] < 1 - 1e-10:
        error = SceneError(
            f"Symmetry(where={symmetry.where!r}): its facets are not all perpendicular to one "
            "coordinate axis, and supports fix components. Change the mesh, or select one plane."
        )
    if symmetry.normal is not None and error is None:
        given = finite(symmetry.normal)
        normal = np.zeros(0) if given is None else np.atleast_1d(given)
        size = float(np.linalg.norm(normal))
        fits = normal.shape in ((mesh.geometry.dim,), (3,)) and size > 0
        if not fits or abs(normal[axis]) < size * (1 - 1e-10):
            error = SceneError(
                f"Symmetry: normal={short(symmetry.normal)}, but the facets are perpendicular to "
                f"{AXES[axis]}. Give that axis, or leave it out."
            )
    agree(mesh.comm, error)
    at = found.centres[:, axis]
    low = mesh.comm.allreduce(float(at.min(initial=np.inf)), op=MPI.MIN)
    high = mesh.comm.allreduce(float(at.max(initial=-np.inf)), op=MPI.MAX)
    x = np.asarray(mesh.geometry.x)[:, axis]
    size = mesh.comm.allreduce(float(np.abs(x).max(initial=0.0)), op=MPI.MAX)
    if high - low > 1e-9 * size:
        raise SceneError(
            f"Symmetry(where={symmetry.where!r}): its facets are in several planes, from "
            f"{AXES[axis]} = {low:.6g} to {high:.6g}. Give each plane its own Symmetry."
        )
    return axis


def actions(scene: Scene, symmetry: Symmetry, axis: int) -> tuple[Array, Array, Array]:
    """Q and what the mirror does to u and to ν.

    Raises:
        SceneError: if a parity is missing, does not fit, or mixes components.
    """
    mirror = np.eye(3)
    mirror[axis, axis] = -1.0
    n_u, k = scene.displacement, scene.descriptor
    if n_u == 1 and scene.mesh.geometry.dim > 1 and isinstance(symmetry.u, str):
        if symmetry.u not in ("even", "odd"):
            raise SceneError(
                "Symmetry: which way the one component of u points is not known. Give u='even' if "
                "it lies in the plane (antiplane shear), else u='odd'."
            )
    parity = symmetry.parity
    if parity is None:
        told = {repr(body.parity): body.parity for body in scene.bodies}
        parity = next(iter(told.values()))
        if len(told) > 1 or parity is None:
            raise SceneError(
                "Symmetry: how ν goes under the mirror is not known. Give parity='polar', 'axial', "
                "'even', 'odd', 'tensor', or a k×k matrix."
            )
    S, R = representation(symmetry.u, mirror, n_u, "u"), representation(parity, mirror, k, "ν")
    for matrix, what in ((S, "u"), (R, "ν")):
        if np.abs(matrix - np.diag(np.diag(matrix))).max() > 1e-12:
            raise SceneError(
                f"Symmetry: the mirror perpendicular to {AXES[axis]} mixes components of {what}, "
                "and supports fix components. Change to a basis in which the matrix is diagonal."
            )
    return mirror, S, R


def fixed_components(scene: Scene, symmetry: Symmetry, axis: int) -> dict[str, Ints]:
    """Components of "u" and "nu" that vanish on the plane.

    Raises:
        SceneError: as :func:`actions`.
    """
    _, S, R = actions(scene, symmetry, axis)
    return {"u": np.flatnonzero(np.diag(S) < 0), "nu": np.flatnonzero(np.diag(R) < 0)}


def check_mirrors(problem: Problem) -> None:
    """Refuse planes in which a body of the scene does not look the same; collective.

    Raises:
        SceneError: naming the body, what changes, and by how much (on all ranks).
    """
    scene = problem.scene
    for symmetry, axis in problem.supports.mirrors:
        mirror, S, R = actions(scene, symmetry, axis)
        for number, body in enumerate(scene.bodies):
            changes = {"energy": _of_energy(problem, number, mirror, S, R)}
            for name in ("inertia", "viscosity"):
                if not callable(getattr(body, name)):
                    given = getattr(body, f"{name}_matrix")
                    changes[name] = _relative(R.T @ given @ R, given)
            if body.potential is not None:
                changes["potential"] = sampled(scene, number, "potential", mirror, S, R)
            for name, change in changes.items():
                changes[name] = problem.comm.allreduce(change, op=MPI.MAX)
            what = max(changes, key=lambda name: changes[name])
            worst = changes[what]
            if worst > TOLERANCE:
                raise SceneError(
                    f"Symmetry: the {what} of {body.name} is not the same in the mirror "
                    f"perpendicular to {AXES[axis]}: it changes by {worst:.2g} of its size. Give "
                    "the right parity=, or model the whole body."
                )


def _relative(mirrored: Array, given: Array) -> float:
    """Largest change of a matrix, each entry relative to its diagonal's."""
    size = np.sqrt(np.abs(np.diag(given)))
    scale = np.outer(size, size)
    change = np.abs(mirrored - given)
    return float(np.where(scale > 0, change / np.where(scale > 0, scale, 1.0), 0.0).max(initial=0))


def _of_energy(problem: Problem, number: int, Q: Array, S: Array, R: Array) -> float:
    samples = problem.hessian_samples(number)
    every = problem.comm.allreduce(len(samples), op=MPI.MAX)
    if not every:
        return sampled(problem.scene, number, "energy", Q, S, R)
    n, n_u = problem.scene.components, problem.scene.displacement
    whole = np.zeros((n, n))
    whole[:n_u, :n_u], whole[n_u:, n_u:] = S, R
    T = np.zeros((4 * n, 4 * n))
    T[: 3 * n, : 3 * n], T[3 * n :, 3 * n :] = np.kron(whole, Q), whole
    return max((_relative(T.T @ H @ T, H) for H in samples), default=0.0)


def sampled(scene: Scene, number: int, what: str, Q: Array, S: Array, R: Array) -> float:
    """Change of a density in a mirror, relative to its size; collective.

    Args:
        scene: The scene.
        number: Region, in up to 64 of whose cells on this rank three random states are looked at.
        what: "energy" or "potential".
        Q: What the mirror does to space.
        S: To u.
        R: To ν.
    """
    mesh, body, dim = scene.mesh, scene.bodies[number], scene.mesh.geometry.dim
    n_u, k = scene.displacement, scene.descriptor
    shapes = ((n_u,), (n_u, dim), (k,), (k, dim))
    states = [fem.Constant(mesh, np.zeros(shape)) for shape in shapes]
    u, U, nu, N = states

    def padded(part: Any, rows: int) -> Any:
        return ufl.as_tensor(
            [[part[i, j] if j < dim else 0.0 for j in range(3)] for i in range(rows)]
        )

    if what == "energy":
        density = body.energy(padded(U, n_u), nu, padded(N, k))
    else:
        assert body.potential is not None
        density = body.potential(u, nu)
    compiled = _compat.expression(ufl.as_vector([density]), _compat.cell_space(mesh))
    cells = np.flatnonzero(scene.regions() == number).astype(np.int32)[:64]
    q, rng, worst = Q[:dim, :dim], np.random.default_rng(0), 0.0
    for _ in range(3):
        random = [0.1 * rng.uniform(0.5, 1.0, shape) * rng.choice([-1, 1], shape)
                  for shape in shapes]  # fmt: skip
        v, V, w, W = random
        turned = [S @ v, S @ V @ q.T, R @ w, R @ W @ q.T]
        values = []
        for given in (random, turned):
            for constant, numbers in zip(states, given, strict=True):
                constant.value[...] = numbers
            values.append(_compat.evaluate(compiled, mesh, cells))
        size = np.maximum(np.abs(values[0]), np.abs(values[1])).max(initial=1e-300)
        worst = max(worst, float(np.abs(values[0] - values[1]).max(initial=0.0) / size))
    return worst
