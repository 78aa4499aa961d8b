# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Fields that follow from (u, ν) and their rates: stresses, actions, energies, dissipation.

P = ∂e/∂U, z = ∂e/∂ν and S = ∂e/∂N (paper §2, per unit volume) are taken per reference area and
volume; with F = I + ∇u the actual configuration sees

.. math:: \sigma = \frac{PF^{\mathsf T}}{\det F},\quad S_e = \frac{SF^{\mathsf T}}{\det F},\quad
          z_e = \frac{z}{\det F}.

For energies quadratic in ∇u, which hold for small ∇u only, the two differ by terms that such an
energy has not. Everything is taken at cells' midpoints: exact for what depends on gradients alone,
second order else. Averages at nodes are by volume of the cells that meet there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import ufl
from dolfinx import fem

from complexbody import _compat, nodal
from complexbody._compat import Array
from complexbody.action import Action
from complexbody.body import Body
from complexbody.densities import deformation, scalar
from complexbody.errors import OutputError
from complexbody.kinetics import co_energy

if TYPE_CHECKING:
    from complexbody.result import Result

#: Fields per cell and the symbols they are stored under.
CELL_FIELDS = {
    "stress": "P",  # (n_u, 3) [Pa]
    "self_action": "z",  # (k,) [J/m³ per unit of ν]
    "microstress": "S",  # (k, 3) [J/m² per unit of ν]
    "energy_density": "e",  # ρe [J/m³]
    "cauchy_stress": "sigma",  # σ = PFᵀ/det F, (n_u, 3)
    "actual_self_action": "z_e",  # z/det F, (k,)
    "actual_microstress": "S_e",  # SFᵀ/det F, (k, 3)
    "kinetic_density": "kinetic",  # ½ρ|u̇|² + χ(ν, ν̇) [J/m³]
    "dissipation": "power",  # ν̇·ην̇, the dissipated power [W/m³]
}
_NODES = "_at_nodes"
#: The same averaged to nodes.
NODAL_FIELDS = {name + _NODES: symbol for name, symbol in CELL_FIELDS.items()}


class Derived:
    """Derived fields of a scene: each body's expressions at cell midpoints, compiled once.

    Args:
        action: The forms of the scene.
        names: Of :data:`CELL_FIELDS` and :data:`NODAL_FIELDS`.

    Raises:
        BodyError: if a field of the actual configuration is asked for and u has more than three
            components.
    """

    def __init__(self, action: Action, names: Sequence[str]) -> None:
        self._names, self._scene = tuple(names), action.scene
        self._base = tuple(dict.fromkeys(name.removesuffix(_NODES) for name in names))
        if not names:
            return
        self._q, self._rate = (fem.Function(action.space) for _ in range(2))
        self._regions = action.scene.regions()
        self._expressions = []
        for body in action.scene.bodies:
            fields = _expressions(action, body, self._q, self._rate, self._base)
            self._shapes = [fields[name].ufl_shape for name in self._base]
            # q[0] ties the expression to the mesh, also where the energy does not depend on q.
            parts = [self._q[0]]
            for name, shape in zip(self._base, self._shapes, strict=True):
                parts += [fields[name][i] if shape else fields[name] for i in np.ndindex(shape)]
            space = _compat.cell_space(action.scene.mesh)  # its one point is the midpoint
            self._expressions.append(_compat.expression(ufl.as_vector(parts), space))

    def evaluate(self, state: Mapping[str, Any]) -> dict[str, Array]:
        """Each field on this rank's own cells or nodes, (number, components row by row).

        Collective.

        Args:
            state: P1 Functions "u", "nu", "u_dot", "nu_dot"; rates only where a field needs them.
        """
        if not self._names:
            return {}
        scene, nodes = self._scene, _compat.node_map(self._scene.mesh).size_local
        for function, suffix in ((self._q, ""), (self._rate, "_dot")):
            record = function.x.array.reshape(-1, scene.components)
            for name in ("u", "nu"):
                if name + suffix in state:
                    values = state[name + suffix].x.array
                    columns = scene.components_of(name)
                    record[:nodes, columns] = values.reshape(-1, len(columns))[:nodes]
            function.x.scatter_forward()
        sizes = [math.prod(shape) for shape in self._shapes]
        table = np.zeros((len(self._regions), 1 + sum(sizes)))
        for region, expression in enumerate(self._expressions):
            cells = np.flatnonzero(self._regions == region).astype(np.int32)
            table[cells] = _compat.evaluate(expression, scene.mesh, cells)
        split = np.split(table, np.cumsum([1, *sizes]), axis=1)[1:-1]
        base = dict(zip(self._base, split, strict=True))
        out: dict[str, Array] = {}
        for name in self._names:
            values = base[name.removesuffix(_NODES)]
            if name.endswith(_NODES):
                average = nodal.averages(scene.mesh, values).x.array
                values = average.reshape(-1, values.shape[1])[:nodes]
            out[name] = values
        return out


def derived_fields(result: Result, *names: str) -> dict[str, fem.Function]:
    """Derived fields of a result's final state as dolfinx Functions, for pictures and more.

    Collective. Components are row by row, as many as the field has.

    Args:
        result: What :func:`complexbody.simulate` returned.
        names: Of :data:`CELL_FIELDS` (piecewise constant Functions) and :data:`NODAL_FIELDS`,
            the same with "_at_nodes" (P1 Functions).

    Raises:
        OutputError: for other names.
        BodyError: as :class:`Derived`.
    """
    known = {**CELL_FIELDS, **NODAL_FIELDS}
    for name in names:
        if name not in known:
            raise OutputError(f"derived_fields: no field {name!r}. Give {', '.join(known)}.")
    mesh = result.scene.mesh
    state = {name: getattr(result, name) for name in ("u", "nu", "u_dot", "nu_dot")}
    out: dict[str, fem.Function] = {}
    for name, values in Derived(Action(result.scene), names).evaluate(state).items():
        count = values.shape[1]
        made = _compat.vector_space if name.endswith(_NODES) else _cells
        out[name] = fem.Function(made(mesh, count), name=name)
        table = out[name].x.array.reshape(-1, count)
        if name.endswith(_NODES):
            table[: len(values)] = values
        else:
            dofs = _compat.cell_dofs(out[name].function_space)[: len(values), 0]
            table[dofs] = values
        out[name].x.scatter_forward()
    return out


def _cells(mesh: Any, count: int) -> fem.FunctionSpace:
    return _compat.cell_space(mesh, (count,))


def _expressions(
    action: Action, body: Body, q: Any, rate: Any, names: Sequence[str]
) -> dict[str, Any]:
    """The fields that are asked for, in UFL."""
    _, *arguments = action.fields(q)
    nu, U, N = (ufl.variable(argument) for argument in arguments)
    energy = scalar(f"energy of {body.name}", body.energy, U, nu, N)
    z, P, S = (ufl.diff(energy, argument) for argument in (nu, U, N))
    out = {"stress": P, "self_action": z, "microstress": S, "energy_density": energy}
    if any(name.startswith(("cauchy", "actual")) for name in names):
        F = deformation(U)
        J = ufl.det(F)
        out["cauchy_stress"] = ufl.dot(P, ufl.transpose(F)) / J
        out["actual_self_action"] = z / J
        out["actual_microstress"] = ufl.dot(S, ufl.transpose(F)) / J
    u_dot, nu_dot, _, _ = action.fields(rate)
    if "kinetic_density" in names:
        chi = co_energy(body, nu, nu_dot)
        out["kinetic_density"] = 0.5 * body.density * ufl.inner(u_dot, u_dot) + chi
    eta = ufl.as_matrix(body.viscosity_matrix.tolist())
    out["dissipation"] = ufl.dot(nu_dot, ufl.dot(eta, nu_dot))
    return out
