# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Plane waves of a body in space, from its energy, potential, inertia and viscosity alone.

Small motions about a uniform state at rest, ∝ a exp i(q·x − ωt), obey

.. math:: (K(q) - i\omega(D + G) - \omega^2M)\,a = 0,

with K(q) of the Hessians of ρe and ρw (:mod:`complexbody.waves`), M = diag(ρ, …, ∂²χ/∂ν̇∂ν̇) and
D = diag(0, …, η). A χ(ν, ν̇) that is not ½ν̇·Ων̇ adds G = C − Cᵀ with C = ∂²χ/∂ν̇∂ν to D, and
−∂²χ/∂ν∂ν to K, all at ν̇ = 0. Knows no mesh and no time stepping.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from complexbody import hessian
from complexbody.densities import scalar
from complexbody.errors import BodyError
from complexbody.hessian import NotQuadratic, Quadratic
from complexbody.waves import Complex, Scales, plane_waves, scales, wave_matrix

if TYPE_CHECKING:
    from complexbody.body import Body

Array = npt.NDArray[np.float64]
#: Relative change of H, over the move to the nearest rest, from which on a state is not at rest.
REST = 1e-6


def of_body(
    body: Body, q: Any, state: dict[str, Any], polarisations: bool
) -> Complex | tuple[Complex, Complex]:
    """See :meth:`complexbody.body.Body.dispersion`."""
    vectors = np.asarray(q, dtype=np.float64)
    vectors = vectors[None] if vectors.ndim == 0 else vectors
    if not 1 <= vectors.shape[-1] <= 3 or not np.isfinite(vectors).all():
        raise BodyError(
            f"dispersion: q has shape {vectors.shape}, or is not finite. Give one number along x, "
            "or finite wave vectors of 1 to 3 components in the last axis, in 1/m."
        )
    H, M, D = linearised(body, **state)
    flat = vectors.reshape(-1, vectors.shape[-1])
    found = [plane_waves(wave_matrix(H, one), M, D) for one in flat]
    shape, n = vectors.shape[:-1], len(M)
    branches = len(found[0][0]) if found else 0
    omega = np.array([w for w, _ in found], np.complex128).reshape(*shape, branches)
    if not polarisations:
        return omega
    return omega, np.array([a for _, a in found], np.complex128).reshape(*shape, n, branches)


def scales_of(body: Body, cell: float, size: float, dim: int) -> Scales:
    """See :meth:`complexbody.body.Body.scales`."""
    if not (0 < cell < np.inf and 0 < size < np.inf and dim in (1, 2, 3)):
        raise BodyError(
            f"scales: cell is {cell}, size {size} and dim {dim}. Give positive lengths in m, and "
            "1, 2 or 3 dimensions."
        )
    H, M, D = linearised(body)
    return Scales(scales(H, M, 0.5 * (D + D.T), body.displacement, cell, size, dim))


def linearised(
    body: Body, u: Any = 0.0, U: Any = 0.0, nu: Any = 0.0, N: Any = 0.0
) -> tuple[Array, Array, Array]:
    """H (4n, 4n) of ρe + ρw (less that of χ), M and D + G (n, n), at a state, in the order of H.

    Args:
        body: The body.
        u: Displacement, a number for all components or shape (n_u,).
        U: ∇u, a number or shape (n_u, 3).
        nu: ν, a number or shape (k,).
        N: ∇ν, a number or shape (k, 3).

    Raises:
        BodyError: if a coefficient varies in space, there is no second derivative, or the body is
            not linear and its state not at rest.
    """
    n_u, k, n = body.displacement, body.descriptor, body.components
    given = {"u": (u, (n_u,)), "U": (U, (n_u, 3)), "nu": (nu, (k,)), "N": (N, (k, 3))}
    state = {name: _shaped(name, *what) for name, what in given.items()}
    if hasattr(body.density, "function_space"):
        raise _varies(body, "density")
    first = 3 * n + n_u

    def parts(u: Array, nu: Array) -> tuple[Array, Array, Array, Array, bool]:
        """H, M, D and the forces on (u, ν); whether all of it is linear."""
        stored, linear = _read(body, "energy", (state["U"], nu, state["N"]))
        H, force = _numbers(body, "energy", stored, n)
        M, D = np.zeros((n, n)), np.zeros((n, n))
        M[:n_u, :n_u] = float(body.density) * np.eye(n_u)
        D[n_u:, n_u:] = body.viscosity_matrix
        if body.potential is not None:
            outer, quadratic = _read(body, "potential", (u, nu))
            linear = linear and quadratic
            extra = _numbers(body, "potential", outer, n)
            H, force = H + extra[0], force + extra[1]
        if not callable(body.inertia):
            M[n_u:, n_u:] = body.inertia_matrix
            return H, M, D, force[3 * n :], linear
        chi, quadratic = _read(body, "inertia", (nu, np.zeros(k)))
        second, slope = _numbers(body, "kinetic co-energy", chi, 2 * k)
        at, rate = slice(6 * k, 7 * k), slice(7 * k, 8 * k)
        M[n_u:, n_u:] = second[rate, rate]
        D[n_u:, n_u:] += second[rate, at] - second[rate, at].T
        H[first:, first:] -= second[at, at]
        force[first:] -= slope[at]
        return H, M, D, force[3 * n :], linear and quadratic

    H, M, D, force, linear = parts(state["u"], state["nu"])
    if not linear and force.any():  # superposition makes any state of a linear body as good
        own = H[3 * n :, 3 * n :]
        move = -np.linalg.pinv(own, 1e-12, hermitian=True) @ force
        moved = parts(state["u"] + move[:n_u], state["nu"] + move[n_u:])[0]
        left, most = force + own @ move, np.abs(H).max()
        if np.abs(moved - H).max() > REST * most or np.abs(left).max() > REST * np.abs(force).max():
            raise BodyError(
                f"dispersion: {body.name} is not at rest at this state: forces on (u, ν) are "
                f"{force}, and H changes with the move {move} that would relax them. Give a state "
                "where e + w is stationary in u and ν."
            )
    return H, M, D


def _shaped(name: str, value: Any, shape: tuple[int, ...]) -> Array:
    try:
        out = np.broadcast_to(np.asarray(value, dtype=np.float64), shape)
    except (TypeError, ValueError):
        out = np.full(shape, np.nan)
    if not np.isfinite(out).all():
        raise BodyError(
            f"dispersion: {name} is {value!r}. Give a finite number, or an array of shape {shape}."
        )
    return out


def _read(body: Body, what: str, state: tuple[Array, ...]) -> tuple[Quadratic, bool]:
    """The Taylor polynomial of a density at a state, and whether it is all of it."""
    name = {"inertia": "kinetic co-energy"}.get(what, what)
    values = "gradients" if what == "energy" else "fields"
    n_u, k = (body.descriptor if what == "inertia" else body.displacement), body.descriptor

    def density(*arguments: Any) -> Any:
        return scalar(f"{name} of {body.name}", getattr(body, what), *arguments)

    found = hessian.read(density, None, n_u, k, values)
    if found is not None:
        return found, True
    try:
        return hessian.read_at(density, n_u, k, values, state), False
    except NotQuadratic:
        raise BodyError(
            f"dispersion: the {name} of {body.name} has no second derivative at this state, or "
            "one that cannot be read. Change the state, or write it without conditionals."
        ) from None


def _numbers(body: Body, name: str, found: Quadratic, n: int) -> tuple[Array, Array]:
    """Hessian (4n, 4n) and gradient (4n,) as numbers."""
    if found.expressions():
        raise _varies(body, name)
    H, slope = np.zeros((4 * n, 4 * n)), np.zeros(4 * n)
    for at, value in found.hessian.items():
        H[at] = value
    for i, value in found.linear.items():
        slope[i] = value
    return H, slope


def _varies(body: Body, what: str) -> BodyError:
    return BodyError(
        f"dispersion: the {what} of {body.name} reads a Function, and where coefficients vary "
        "there are no plane waves. Give a body with the numbers of one place."
    )
