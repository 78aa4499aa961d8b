# SPDX-License-Identifier: LGPL-3.0-or-later
"""A scene made ready to run: its forms, arrays, kernels, masses, supports, loads, initial state.

Every integrator starts from a :class:`Problem`. Checks of the user's input that need arrays are
made here, on all ranks together and before any stepping.
"""

from __future__ import annotations

import copy
import ctypes
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI

from complexbody import _compat, boundary, loading, native
from complexbody.action import Action
from complexbody.assumptions import check_energy, hessian_samples
from complexbody.body import Body
from complexbody.convexity import Convexity, Range
from complexbody.dampers import Dampers, dampers
from complexbody.discretisation import Discretisation
from complexbody.errors import BodyError, SceneError
from complexbody.histories import shifted
from complexbody.kernels.library import Kernels
from complexbody.live import Live, live
from complexbody.masses import Masses
from complexbody.mirrors import check_mirrors
from complexbody.reduction import reduced_data, reduced_scene
from complexbody.scene import FIELDS, Scene
from complexbody.stiffness import self_stiffness

Array = npt.NDArray[np.float64]


class Problem:
    """A scene with everything an explicit integrator needs; collective.

    With ``reduce`` components that stay zero are left out (:mod:`complexbody.live`).

    Attributes:
        scene, action, disc, kernels, masses: The layers below.
        whole, whole_action: The user's scene, with the components that ``scene`` leaves out.
        live: Which components ``scene`` has, and why.
        full: The problem of ``whole``, whose critical steps are those of the run, until released.
        supports, loads: In geometry nodes.
        self_stiffness: S per body of an implicit self-action (bodies, k, k); else zero.
        dampers: Of absorbing boundaries, if there are any.
        node_step: h of its inertia Ω + h²S/4 [s], of all nodes or each (dolfinx's numbers).
        moving: (node, component) of supports that move, sorted by node; own numbering.
        load_position, load_group, load_value: Entries of load vectors in flat node records.
        start: Initial fields and rates of all geometry nodes, without supports.
        inertias: The bodies as the user gave them: of those with a general χ(ν, ν̇), ``scene`` has
            the lower bound γI in its place.
        convexity, kinetic_range: Of general χ: how γ, Ξ and T₀ are measured (None if there is no
            such χ), and what they are at the initial state.
        quiet: Whether runs may skip cells at rest, which changes no bit.
        known_steps: Critical steps of owned cells by dissipation scheme, as far as computed [s].
        warnings: What A1 leaves to the boundary data, and locking, in words.

    Raises:
        SceneError, MeshError, BodyError, CoercivityError: for input that cannot be run.
    """

    disc: Discretisation
    self_stiffness: Array
    dampers: Dampers | None

    def __init__(self, scene: Scene, reduce: bool = False) -> None:
        self.scene, self.whole, self.comm = scene, scene, scene.mesh.comm
        self.action = self.whole_action = Action(scene)
        self.action.check_densities()
        dofs = _compat.cell_dofs(self.action.space)
        # All layers below rely on one numbering of nodes and P1 degrees of freedom.
        assert np.array_equal(dofs, _compat.cell_nodes(scene.mesh))
        self.supports = boundary.supports(scene, self.action)
        self.loads = loading.loads(scene, self.action)
        self.start = boundary.initial(scene, self.action)
        self._read_inertia()
        self.node_step: float | Array = 0.0
        self.quiet = True
        self.known_steps: dict[str, Array] = {}
        self.arrange()
        try:
            self.warnings = check_energy(self)
            check_mirrors(self)
        except (BodyError, SceneError):  # which all ranks have: closing is collective
            self.close()
            raise
        self.live = Live(tuple(range(scene.components)), {}, scene.components)
        self.full: Problem = self
        if reduce:
            self.live = live(
                self.scene, self.kernels.densities, self.supports, self.loads, self.start
            )
        if not self.live.all:
            self._reduce()

    def _reduce(self) -> None:
        """Leave out components that no source reaches."""
        self.full = full = copy.copy(self)
        full.full, full.live = full, replace(self.live, components=tuple(range(self.live.total)))
        self.supports, self.loads, self.start = reduced_data(
            self.live, self.supports, self.loads, self.start
        )
        nu = np.array([i for i in self.live.components if i >= self.whole.displacement], dtype=int)
        nu -= self.whole.displacement
        self.self_stiffness = full.self_stiffness[:, nu][:, :, nu]
        if full.dampers is not None:
            self.dampers = full.dampers.reduced(self.live.components)
        self.scene = reduced_scene(self.whole, self.live)
        self.action = Action(self.scene)
        self._read_inertia()
        # The layout is the other one's, with smaller records: nothing of it is computed anew.
        late = [np.any(p.supports.moving, axis=1) for p in (self, full)]
        if self.comm.allreduce(np.array_equal(*late), op=MPI.LAND):
            self.disc = full.disc.reduced(self.scene)
            self.kernels = Kernels(self.action, self.disc)
        else:
            del self.disc
        self.arrange()

    def release(self) -> None:
        """Give up what only steps and stiffnesses of all components needed; collective."""
        if self.full is not self:
            self.full.close()
            self.full, self.known_steps = self, {}

    def spread(self, values: Array) -> Array:
        """Values of the scene's components (…, n) among zeros for those left out (…, n_u + k)."""
        if self.live.all:
            return values
        out = np.zeros((*values.shape[:-1], self.live.total))
        out[..., list(self.live.components)] = values
        return out

    def _read_inertia(self) -> None:
        """Convexity of a general χ at the initial state; its γ stands for it in all layers below.

        The scene of those layers has γI for the inertia of such a body: a lower bound, so that
        critical steps are safe at the start.
        """
        self.convexity: Convexity | None = None
        self.kinetic_range = Range()
        self.inertias = self.scene.bodies
        if not any(callable(body.inertia) for body in self.inertias):
            return
        self.convexity = Convexity(self.scene)
        fields, rates = (a.copy() for a in self.start)
        rows, columns = np.nonzero(self.supports.fixed)
        fields[rows, columns] = self.supports.targets(rows, columns, 0.0)
        rates[rows, columns] = 0.0
        nu = self.scene.components_of("nu")
        found = self.convexity.measure(fields[:, nu], rates[:, nu])
        for part in found.values():
            self.kinetic_range.widen(part)
        bodies = [
            replace(b, inertia=found[r].gamma) if r in found else b
            for r, b in enumerate(self.inertias)
        ]
        body = self.scene.body
        tagged: Body | dict[int, Body] = bodies[0]
        if not isinstance(body, Body):
            tagged = dict(zip(sorted(body), bodies, strict=True))
        self.scene = replace(self.scene, body=tagged)

    def arrange(self, group: npt.NDArray[np.int64] | None = None) -> None:
        """Lay out cells and nodes (anew), cells of one block being of one group; collective.

        What is laid out so already stays.

        Args:
            group: A whole number per owned cell, or None for one group.
        """
        scene, moving = self.scene, self.supports.moving
        if not self._laid_out(group):
            if hasattr(self, "disc"):
                self.disc.halo.close()
            self.disc = Discretisation(scene, np.flatnonzero(moving.any(axis=1)), group)
            self.kernels = Kernels(self.action, self.disc)
            self._group = None if group is None else np.array(group)
        disc = self.disc
        fixed = self.supports.fixed[disc.dof]
        if not hasattr(self, "self_stiffness"):
            self.self_stiffness = np.zeros((len(scene.bodies), scene.descriptor, scene.descriptor))
            if scene.self_action == "implicit":
                self.self_stiffness = self_stiffness(scene, self.kernels.densities)
            self.dampers = dampers(self)
        self.masses = self._stiffened()
        # Whatever integrator follows, kinetic energies are those of the whole Ω.
        self.kernels.select(self.masses.diagonal, damped=False, whole=self.masses.whole)
        rows, columns = np.nonzero(moving[disc.dof])
        self.moving = rows.astype(np.int64), columns.astype(np.int32)
        self._lay_loads()
        self._initial(*self.start, fixed)

    def _lay_loads(self) -> None:
        loads, disc = self.loads, self.disc
        self.load_position = disc.number[loads.node] * disc.record + loads.component
        self.load_group, self.load_value = loads.group, loads.value

    def stiffen(self, step: float | Array) -> None:
        """Give nodes the inertia Ω + h²S/4 of an implicit self-action; kept by ``arrange``.

        Args:
            step: h [s], for all nodes, or of each node of this rank in dolfinx's numbering.
        """
        if np.any(self.self_stiffness):
            self.node_step = step
            self.masses = self._stiffened()

    def _stiffened(self) -> Masses:
        step = self.node_step
        if isinstance(step, np.ndarray):
            step = step[self.disc.dof]
        fixed = self.supports.fixed[self.disc.dof]
        return Masses(self.disc, fixed, self.self_stiffness, step, self.dampers)

    def _initial(self, fields: Array, rates: Array, fixed: Any) -> None:
        disc, sup = self.disc, self.supports
        x0, v0 = disc.gather(fields), disc.gather(rates)
        rows, columns = np.nonzero(fixed)
        dofs = disc.dof[rows]
        x0[rows, columns] = sup.targets(dofs, columns, 0.0)
        v0[rows, columns] = 0.0
        self.initial_fields, self.initial_rates = x0, v0

    def _laid_out(self, group: npt.NDArray[np.int64] | None) -> bool:
        """Whether cells are in these groups already, on all ranks; collective."""
        if not hasattr(self, "disc"):
            return False
        if group is None or self._group is None:
            return group is None and self._group is None
        return bool(self.comm.allreduce(np.array_equal(group, self._group), op=MPI.LAND))

    def restart(self, fields: Array, rates: Array, t: float) -> None:
        """Let the next runs begin with another state, at the time ``t`` of the scene's histories.

        Args:
            fields: (u, ν) of this rank's geometry nodes, shape (geometry nodes, n).
            rates: Of the same.
            t: Time [s], from which runs count theirs; runs already made are of no more use.
        """
        self.start = fields, rates
        if not self.kernels.densities.linear:
            self.known_steps = {}
        for histories in (self.loads.histories, self.supports.histories):
            histories[:] = [shifted(history, t) for history in histories]
        self._lay_loads()
        self._initial(fields, rates, self.supports.fixed[self.disc.dof])

    def targets(self, t: float) -> Array:
        """Prescribed values of the moving components at time t, in the order of ``moving``."""
        rows, columns = self.moving
        return self.supports.targets(self.disc.dof[rows], columns, t)

    def rates_at_start(self, tick: float) -> Array:
        """Initial rates (nodes, n), prescribed motions by a one-sided second-order difference."""
        rates = self.initial_rates.copy()
        if len(self.moving[0]):
            now, one, two = (self.targets(i * tick) for i in range(3))
            rates[self.moving] = (-3 * now + 4 * one - two) / (2 * tick)
        return rates

    def hessian_samples(self, number: int) -> Array:
        """H of ρe of region ``number``: see :func:`complexbody.assumptions.hessian_samples`."""
        return hessian_samples(self, number)

    def load_forces(self, amplitude: Array) -> None:
        """f += loads with the given factors per group (partial, before the halo's sum)."""
        if len(self.load_value):
            self.kernels.c.cb_add_loads(
                ctypes.c_int64(len(self.load_value)), native.pointer(self.load_position),
                native.pointer(self.load_group), native.pointer(self.load_value),
                native.pointer(amplitude), native.pointer(self.kernels.f),
            )  # fmt: skip

    def load_power(self, amplitude: Array, rates: Array) -> float:
        """Power of this rank's partial loads on rates in node records [W]."""
        if not len(self.load_value):
            return 0.0
        return float(
            self.kernels.c.cb_power(
                ctypes.c_int64(len(self.load_value)), native.pointer(self.load_position),
                native.pointer(self.load_group), native.pointer(self.load_value),
                native.pointer(amplitude), native.pointer(rates),
            )
        )  # fmt: skip

    def functions(self, fields: Array, rates: Array) -> dict[str, fem.Function]:
        """dolfinx Functions u, nu, u_dot, nu_dot from node records; collective."""
        out: dict[str, fem.Function] = {}
        for suffix in ("", "_dot"):
            for name in FIELDS:
                columns = self.whole.components_of(name)
                out[name + suffix] = fem.Function(
                    _compat.vector_space(self.whole.mesh, len(columns)), name=name + suffix
                )
        self.fill(out, fields, rates)
        return out

    def fill(self, functions: dict[str, fem.Function], fields: Array, rates: Array) -> None:
        """Values of node records (at least nodes, n) into Functions of all components."""
        nodes, n = self.disc.nodes, self.disc.n
        for values, suffix in ((fields, ""), (rates, "_dot")):
            record = self.spread(values[:nodes, :n])
            for name in FIELDS:
                part = np.ascontiguousarray(record[:, self.whole.components_of(name)])
                self.disc.scatter(part, functions[name + suffix])

    def close(self) -> None:
        """Free communicators and requests."""
        self.disc.halo.close()
