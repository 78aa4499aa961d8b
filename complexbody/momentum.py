# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Angular momentum with ν's share.

With 𝒜(ν) the generator of the action of rotations on ν (:mod:`complexbody.rotations`),

.. math:: L = \int (x+u)\times\rho\dot u + \mathcal A(\nu)^*\,\Omega\dot\nu\,dx,

by the lumped masses that runs step with. Objective bodies, free, without viscosity and with an Ω
that rotations leave alone, keep L. So does P1 in space: nodes that turn turn F and ν of every cell,
so each cell's own potential is invariant. Kicks by such potentials change no L, the fields of a
cell being taken at one time; drifts do not either, if 𝒜 is linear in ν and skew by Ω, or constant.
Hence, at any step:

* to round-off: ``Synchronous``, ``AssembledLeapfrog``, plain windows, real steps without correction
  (the paper's), ``Implicit`` with forces taken explicitly;
* to the order of the scheme: balanced windows, where old forces act on new positions;
* corrected cells, whose forces are those of a potential to leading order: to higher order than two;
* not at all: ν with viscosity ην̇, which is not objective, and bodies that something holds.

For infinitesimal actions x stands in the place of x + u: energies quadratic in ∇u keep that.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from complexbody import _compat, nodal
from complexbody.errors import BodyError
from complexbody.rotations import RotationAction
from complexbody.scene import Scene

if TYPE_CHECKING:
    from complexbody.problem import Problem
    from complexbody.result import Result

Array = npt.NDArray[np.float64]


def common_action(scene: Scene) -> RotationAction | None:
    """How ν of a scene turns; None if bodies do not say so, or not the same, or χ is general.

    Bodies of one component of u do not turn either.
    """
    actions = [body.rotation for body in scene.bodies]
    first = actions[0]
    if first is None or not 2 <= scene.displacement <= 3:
        return None
    kind = (first.name, first.components, first.planar)
    for body, action in zip(scene.bodies, actions, strict=True):
        if action is None or (action.name, action.components, action.planar) != kind:
            return None
        if callable(body.inertia):
            return None
    return first


def axes_of(scene: Scene) -> tuple[int, ...]:
    """Axes (from 0) about which a scene has an angular momentum; none if its action is unknown.

    Directions that a mesh does not have do not turn: none in 1D, the third axis in 2D.
    """
    action, dim = common_action(scene), scene.mesh.geometry.dim
    if action is None or dim == 1:
        return ()
    return (2,) if scene.displacement == 2 or dim == 2 else action.axes


class AngularMomentum:
    """L of a run's node records, this rank's share.

    Args:
        problem: The scene, made ready; all its bodies say how ν turns.
    """

    def __init__(self, problem: Problem) -> None:
        action = common_action(problem.whole)
        assert action is not None
        disc, bodies = problem.disc, problem.whole.bodies
        own, share = disc.owned.astype(bool), disc.region_volume
        self._own, self._action, self._spread = own, action, problem.spread
        self._columns, self._n_u = disc.n, problem.whole.displacement
        self._x = disc.position[: len(own)][own]
        self._mass = (disc.volume * disc.density())[own]
        omega = np.array([body.inertia_matrix for body in bodies])
        self._inertia = np.einsum("ar,rij->aij", share[own], omega)

    def __call__(self, fields: Array, rates: Array) -> Array:
        """L, shape (3,) [N m s], of records (at least nodes, n)."""
        q, q_dot = (
            self._spread(a[: len(self._own), : self._columns][self._own]) for a in (fields, rates)
        )
        return moment(self._x, self._mass, self._inertia, self._n_u, self._action, q, q_dot)


def moment(
    x: Array, mass: Array, inertia: Array, n_u: int, action: RotationAction, q: Array, q_dot: Array
) -> Array:
    """Σ_a m_a (x+u)×u̇ + 𝒜(ν)*Ων̇, shape (3,).

    Args:
        x: Places of nodes (nodes, 3).
        mass: ρ integrated over their volumes (nodes,).
        inertia: Ω likewise (nodes, k, k).
        n_u: Components of u.
        action: How ν turns.
        q: (u, ν), shape (nodes, n_u + k).
        q_dot: Their rates.
    """
    pad = ((0, 0), (0, 3 - n_u))
    u, u_dot = np.pad(q[:, :n_u], pad), np.pad(q_dot[:, :n_u], pad)
    place = x if action.infinitesimal else x + u
    orbital = mass @ np.cross(place, u_dot)
    conjugate = np.einsum("aij,aj->ai", inertia, q_dot[:, n_u:])
    spin = np.einsum("aik,ai->k", action.generator(q[:, n_u:]), conjugate)
    return np.asarray(orbital + spin)


def angular_momentum(result: Result, action: RotationAction | None = None) -> Array:
    """L of a result's final state about the origin, shape (3,) [N m s]; collective.

    Components about axes that rotations do not have (of plane bodies and actions) mean nothing.
    In the ledger of a run whose bodies have a ``rotation`` L is in columns of its own.

    Args:
        result: What :func:`complexbody.simulate` returned.
        action: How ν turns; what the bodies say by default.

    Raises:
        BodyError: if that is not known or does not fit, or an inertia is a function.
    """
    scene = result.scene
    action = action or common_action(scene)
    if action is None or action.components != scene.descriptor or scene.displacement > 3:
        raise BodyError(
            f"angular_momentum: how ν (k = {scene.descriptor}) turns is not known. Give "
            "action=cb.rotations.vector() or another one that fits."
        )
    mesh, k = scene.mesh, scene.descriptor
    weight = nodal.volumes(mesh) / (mesh.geometry.dim + 1)
    regions = scene.regions()
    omega = np.array([body.inertia_matrix for body in scene.bodies])
    density = np.ones(len(weight))
    for r, body in enumerate(scene.bodies):
        rho: Any = body.density
        if hasattr(rho, "function_space"):
            dofs = _compat.cell_dofs(rho.function_space)[: len(weight), 0]
            rho = rho.x.array[dofs][regions == r]
        density[regions == r] = rho
    share = np.concatenate([density[:, None], omega[regions].reshape(len(weight), -1)], axis=1)
    own = _compat.node_map(mesh).size_local
    lumps = _records(nodal.sums(mesh, weight[:, None] * share), own)
    q, q_dot = (
        np.concatenate([_records(f, own) for f in pair], axis=1)
        for pair in ((result.u, result.nu), (result.u_dot, result.nu_dot))
    )
    parts = moment(
        mesh.geometry.x[:own], lumps[:, 0], lumps[:, 1:].reshape(own, k, k), scene.displacement,
        action, q, q_dot,
    )  # fmt: skip
    return np.asarray(mesh.comm.allreduce(parts))


def _records(function: Any, nodes: int) -> Array:
    block = function.function_space.dofmap.index_map_bs
    return function.x.array.reshape(-1, block)[:nodes]
