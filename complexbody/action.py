# SPDX-License-Identifier: LGPL-3.0-or-later
r"""The UFL side: the mixed (u, ν) action of a scene, its dissipation and its residuals.

One blocked P1 space carries u and ν side by side (n = n_u + k components per node), so that a
node's record in UFL, in FFCx kernels and in the time loops is the same. Knows no time stepping.

    V(q)    = ∫ ρe(∇u, ν, ∇ν) + ρw(u, ν) dx − ∫_{∂B_t} t·u ds          (paper (potential))
    r(q; v) = δV(q)[v], by ``ufl.derivative``
    D(ν̇; φ) = ∫ ην̇·φ dx, with δ𝒜 − ∫D dt = 0 (paper (Foc-dissipation), its sign corrected)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import ufl
from dolfinx import fem

from complexbody import _compat
from complexbody.body import Body
from complexbody.densities import scalar
from complexbody.errors import BodyError, SceneError, agree
from complexbody.given import finite, is_finite, numbers, short
from complexbody.scene import BodyForce, Pressure, Scene, Traction


def _nodal(found: Any, count: int, points: int, what: str) -> Any:
    """What a user's callable gave, as (components, points).

    Raises:
        SceneError: for another shape: what is merely turned round would be taken otherwise.
    """
    mask = isinstance(found, np.ndarray) and found.dtype == np.bool_  # a predicate means 0 and 1
    given = numbers(found.astype(np.int64) if mask else found)
    if given is None:  # rows of which some are single numbers
        rows = [numbers(row) for row in found] if isinstance(found, Sequence) else []
        each = [r for r in rows if r is not None and r.shape in ((), (points,))]
        if len(each) == len(rows) == count:
            given = np.array([np.broadcast_to(row, points) for row in each])
    elif given.shape == (count,):
        given = np.repeat(given[:, None], points, axis=1)
    elif count == 1 and given.shape in ((), (points,)):
        given = np.broadcast_to(given, (1, points))
    if given is None or given.shape != (count, points):
        shape = "no numbers" if given is None else f"shape {given.shape}"
        raise SceneError(
            f"{what}: vector(x) gave {shape} for x of shape (3, {points}). Give {count} "
            f"component(s): shape ({count}, {points})."
        )
    return given


def _columns(gradient: Any, rows: Sequence[int], dim: int) -> Any:
    """Rows of a gradient as a (len(rows), 3) tensor; columns the mesh does not have are zero."""
    return ufl.as_tensor(
        [[gradient[i, j] if j < dim else ufl.as_ufl(0.0) for j in range(3)] for i in rows]
    )


class Action:
    """Forms of one scene on its mixed P1 space.

    Attributes:
        space: Blocked P1 space of n = n_u + k components.
        q: Function of (u, ν), where residuals are evaluated.
        v: Test function.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.space = _compat.vector_space(scene.mesh, scene.components)
        self.q = fem.Function(self.space, name="q")
        self.v = ufl.TestFunction(self.space)
        # Cell tags may be absent; a measure without them integrates everywhere.
        data = {"subdomain_data": scene.cell_tags} if scene.cell_tags is not None else {}
        self.dx = ufl.Measure("dx", domain=scene.mesh, **data)

    def fields(self, q: Any) -> tuple[Any, Any, Any, Any]:
        """(u, ν, U, N) of a mixed function: shapes (n_u,), (k,), (n_u, 3), (k, 3).

        None for what a reduced scene has no component of.
        """
        n_u, n, dim = self.scene.displacement, self.scene.components, self.scene.mesh.geometry.dim
        gradient, parts = ufl.grad(q), (range(n_u), range(n_u, n))
        u, nu = (ufl.as_vector([q[i] for i in r]) if r else None for r in parts)
        U, N = (_columns(gradient, r, dim) if r else None for r in parts)
        return u, nu, U, N

    def stored_density(self, body: Body, q: Any) -> Any:
        """ρe of the mixed function ``q`` [J/m³]."""
        _, nu, U, N = self.fields(q)
        return scalar(f"energy of {body.name}", body.energy, U, nu, N)

    def potential_density(self, body: Body, q: Any) -> Any | None:
        """ρw of the mixed function ``q`` [J/m³], or None where the body has no potential."""
        if body.potential is None:
            return None
        u, nu, _, _ = self.fields(q)
        return scalar(f"potential of {body.name}", body.potential, u, nu)

    def check_densities(self) -> None:
        """Evaluate all densities once, before anything relies on them; collective.

        Raises:
            BodyError: if one fails on any rank (on all ranks).
        """
        error: Exception | None = None
        try:
            for body in self.scene.bodies:
                self.stored_density(body, self.q)
                self.potential_density(body, self.q)
        except BodyError as found:
            error = found
        agree(self.scene.mesh.comm, error)

    def measure(self, number: int) -> Any:
        """The volume measure on region ``number``: one body may fill several regions."""
        if isinstance(self.scene.body, Body):
            measure = ufl.dx(domain=self.scene.mesh)
        else:
            measure = self.dx(sorted(self.scene.body)[number])
        degree = self.scene.bodies[number].quadrature_degree
        return measure if degree is None else measure(degree=degree)

    def potential_energy(self, q: Any) -> Any:
        """∫ρe + ρw dx as a UFL form (loads excluded: they depend on time)."""
        total = 0
        for number, body in enumerate(self.scene.bodies):
            density = self.stored_density(body, q)
            extra = self.potential_density(body, q)
            total += (density if extra is None else density + extra) * self.measure(number)
        return total

    def residual(self) -> Any:
        """δV(q)[v], the negative of the internal forces, as a UFL form."""
        return ufl.derivative(self.potential_energy(self.q), self.q, self.v)

    def jacobian(self) -> Any:
        """δ²V(q)[v, dq], the tangent stiffness, as a UFL form."""
        return ufl.derivative(self.residual(), self.q, ufl.TrialFunction(self.space))

    def dissipation(self, rate: Any) -> Any:
        """∫ην̇·φ dx as a UFL form: the virtual power δ𝒜 must balance."""
        n_u, n = self.scene.displacement, self.scene.components
        nu_dot = ufl.as_vector([rate[i] for i in range(n_u, n)])
        phi = ufl.as_vector([self.v[i] for i in range(n_u, n)])
        total = 0
        for number, body in enumerate(self.scene.bodies):
            eta = ufl.as_matrix(body.viscosity_matrix.tolist())
            total += ufl.inner(ufl.dot(eta, nu_dot), phi) * self.measure(number)
        return total

    def kernel_form(self, density: Callable[[Any], Any], degree: int | None, rank: int) -> Any:
        """∫density(q) dx over every cell (rank 0), its first (1) or second (2) derivative."""
        measure = ufl.dx(domain=self.scene.mesh)
        expression = density(self.q)
        form = expression * (measure if degree is None else measure(degree=degree))
        if rank > 0:
            form = ufl.derivative(form, self.q, self.v)
        if rank > 1:
            form = ufl.derivative(form, self.q, ufl.TrialFunction(self.space))
        return form

    def load_form(self, load: Traction | Pressure | BodyForce, facet_tags: Any, tag: int) -> Any:
        """∫t·v ds or ∫b·v dx of a load with factor 1 as a UFL form.

        Args:
            load: The load.
            facet_tags: MeshTags in which ``tag`` marks the loaded facets (surface loads).
            tag: That tag.
        """
        scene = self.scene
        if isinstance(load, BodyForce):
            if load.where is None:
                measure = ufl.dx(domain=scene.mesh)
            else:
                measure = self.dx(tuple(int(t) for t in np.atleast_1d(np.asarray(load.where))))
        else:
            measure = ufl.Measure("ds", domain=scene.mesh, subdomain_data=facet_tags)(tag)
        name = "u" if isinstance(load, Pressure) else load.field
        rows = scene.components_of(name)
        v = ufl.as_vector([self.v[int(i)] for i in rows])
        if isinstance(load, Pressure):
            normal, dim = ufl.FacetNormal(scene.mesh), scene.mesh.geometry.dim
            if not is_finite(load.pressure):
                raise SceneError(
                    f"Pressure: pressure is {short(load.pressure)}. Give a finite number in Pa."
                )
            p = float(load.pressure)
            # A Constant, so that the form compiles once for all values.
            pressure = fem.Constant(scene.mesh, p)
            vector = ufl.as_vector(
                [-pressure * normal[i] if i < dim else 0.0 for i in range(len(rows))]
            )
        else:
            vector = self._vector(load.vector, len(rows), type(load).__name__)
        return ufl.inner(vector, v) * measure

    def _vector(self, value: Any, count: int, what: str) -> Any:
        if callable(value):
            function = fem.Function(_compat.vector_space(self.scene.mesh, count))
            function.interpolate(lambda x: _nodal(value(x), count, x.shape[1], what))
            return function
        given = finite(value)
        if given is None or np.atleast_1d(given).shape != (count,):
            raise SceneError(
                f"{what}: vector {short(value)} does not have {count} finite components. Give one "
                "number per component of the field."
            )
        return fem.Constant(self.scene.mesh, np.atleast_1d(given))
