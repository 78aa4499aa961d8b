# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a Hessian of the energy says of a body: coercive or not (A1), and will P1 cells lock?

Numbers only: knows no UFL, no mesh and no ranks.
"""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt

from complexbody.errors import CoercivityError
from complexbody.hessian import names

Array = npt.NDArray[np.float64]

#: Eigenvalues, of matrices with a unit diagonal, that are zero but for round-off.
NULL = 1e-11
#: λ/μ from which on P1 cells are said to lock.
LOCKING = 50.0


def check_coercive(
    hessian: Array, n_u: int, k: int, dim: int, name: str, outer: Array | None = None
) -> list[str]:
    """Check A1 for Hessians of ρe: symmetric, finite, no negative eigenvalue on (sym U, ν, N).

    Args:
        hessian: H of ρe, shape (m, 4n, 4n), in the order of :class:`Quadratic`; m samples.
        n_u: Components of u.
        k: Components of ν.
        dim: Dimension of the mesh: other columns of U and N do not exist.
        name: The body's name, for messages.
        outer: ∂²(ρw)/∂ν∂ν of the potential, shape (samples, k, k), if there is one. It holds null
            modes of e, but never makes up for a negative e. Without samples no mode is told.

    Returns:
        The null modes that nothing holds but inertia and boundary data, in words: rigid rotations
        left out, and those that the potential or the self-action holds.

    Raises:
        CoercivityError: with the eigenvalue and the mode.
    """
    n, labels = n_u + k, names(n_u, k)
    if not np.all(np.isfinite(hessian)):
        raise CoercivityError(f"The energy of {name} has a Hessian that is not finite. Check it.")
    keep, h, d = _scaled(hessian, n_u, k, dim)
    values, vectors = np.linalg.eigh(h)
    worst = int(np.argmin(values[:, 0]))

    def words(vector: Array, scale: Array) -> str:
        mode = vector / scale
        mode = mode / mode[np.argmax(np.abs(mode))]
        big = [i for i in np.argsort(-np.abs(mode)) if abs(mode[i]) > 0.05][:6]
        return " ".join(f"{mode[i]:+.3g} {labels[keep[i]]}" for i in big)

    if values[worst, 0] < -NULL:
        mode = vectors[worst, :, 0]
        amount = float(mode @ h[worst] @ mode)
        raise CoercivityError(
            f"The energy of {name} is not coercive (A1): along the mode {words(mode, d[worst])} it "
            f"is negative (relative eigenvalue {values[worst, 0]:.3e}, g·Hg = {amount:.3e} J/m³). "
            "Change the constants so that the coupling stays below the bound of the form."
        )
    free = _without_rotations(vectors[worst][:, values[worst] < NULL], d[worst], keep, n_u, n, dim)
    if not free.size:
        return []
    full = np.zeros((len(labels), free.shape[1]))
    full[keep] = free / d[worst][:, None]
    own = np.zeros((1, k, k)) if outer is None else outer
    if not len(own):
        return []  # no cells here: others tell
    held = np.array([_held(full, hessian[worst], w, n_u, k) for w in own])
    energies, turns = np.linalg.eigh(held)
    least = int(np.argmin((energies > NULL).sum(axis=1)))
    free = free @ turns[least][:, energies[least] <= NULL]
    return [words(mode, d[worst]) for mode in free.T]


def least_eigenvalue(hessian: Array, n_u: int, k: int, dim: int) -> float:
    """Smallest eigenvalue of H scaled to a unit diagonal, rigid rotations left out; A1 if positive.

    Args:
        hessian: H of ρe, shape (m, 4n, 4n); m samples, as for :func:`check_coercive`.
        n_u: Components of u.
        k: Components of ν.
        dim: Dimension of the mesh.

    Returns:
        The least of all samples; infinity if there is none.
    """
    keep, h, d = _scaled(hessian, n_u, k, dim)
    least = np.inf
    for values, vectors, scale in zip(*np.linalg.eigh(h), d, strict=True):
        null = vectors[:, np.abs(values) < NULL]
        turning = null.size and not _without_rotations(null, scale, keep, n_u, n_u + k, dim).size
        rest = values[np.abs(values) >= NULL] if turning else values
        least = min(least, float(rest.min(initial=np.inf)))
    return least


def _scaled(hessian: Array, n_u: int, k: int, dim: int) -> tuple[list[int], Array, Array]:
    """Unknowns that exist, H of them with a unit diagonal (m, ·, ·), and the roots of its own."""
    n = n_u + k
    keep = [3 * i + j for i in range(n) for j in range(dim)] + [3 * n + n_u + i for i in range(k)]
    # A descriptor the energy does not see is held by its gradients, as u is by its own.
    seen = np.abs(hessian).max(axis=(0, 2), initial=0.0) > 0
    keep = [i for i in keep if i < 3 * n or seen[i]]
    h = hessian[:, keep][:, :, keep]
    # Units differ between U, N and ν: compare each with its own diagonal.
    d = np.sqrt(np.abs(np.einsum("mii->mi", h)))
    d = np.where(d > 0, d, d.max(axis=1, keepdims=True, initial=1e-150))  # its square is divided by
    return keep, h / (d[:, :, None] * d[:, None, :]), d


def _without_rotations(
    null: Array, d: Array, keep: list[int], n_u: int, n: int, dim: int
) -> Array:  # fmt: skip
    """Null modes (scaled, orthonormal) but those that objectivity demands (Korn).

    Rigid rotations: skw U alone, or together with the ν that turns with the body.
    """
    unit, size = np.eye(len(keep)) / d, min(n_u, dim)
    at = {index: row for row, index in enumerate(keep)}
    deformed, turned = [], [np.zeros(len(keep))]
    for i, j in itertools.product(range(n), range(dim)):
        own, other = unit[at[3 * i + j]], unit[at[3 * j + i]] if max(i, j) < size else 0.0
        deformed.append(own + other)
        if max(i, j) < size:
            turned.append(own - other)
    rows = [np.array(part) @ null for part in (deformed, turned)]
    scales = [np.linalg.norm(part, axis=1)[:, None] for part in (deformed, turned)]
    rows = [row / np.where(scale > 0, scale, 1.0) for row, scale in zip(rows, scales, strict=True)]
    rigid = _kernel(rows[0])
    # Of these, a ν alone that costs nothing is no rotation.
    rotation = rigid @ _kernel(_kernel(rows[1] @ rigid).T)
    return null @ _kernel(rotation.T)


def _kernel(rows: Array) -> Array:
    """Orthonormal columns that rows of length about one take to zero."""
    _, sizes, right = np.linalg.svd(rows, full_matrices=True)
    return right[np.count_nonzero(sizes > 1e-6) :].T


def _held(modes: Array, hessian: Array, outer: Array, n_u: int, k: int) -> Array:
    """What holds null modes (4n, m) of ρe apart from gradients, a quadratic form (m, m) of them.

    A mode with a ν of its own is held by the potential, ν·Wν. One of ∇ν alone is held where e + w
    holds ν itself whatever U does: then ν lives at each point by itself, as bubbles do.
    """
    n, first = n_u + k, 3 * (n_u + k) + n_u
    nu, U = slice(first, first + k), slice(0, 3 * n_u)
    own = modes[nu].T @ outer @ modes[nu]
    relaxed = np.linalg.pinv(hessian[U, U], NULL, hermitian=True)
    still = hessian[nu, nu] + outer - hessian[nu, U] @ relaxed @ hessian[U, nu]
    scale = np.sqrt(np.abs(np.diag(hessian[nu, nu] + outer)))
    if not scale.any():
        return own
    inverse = np.where(scale > 0, 1 / np.where(scale > 0, scale, 1.0), 0.0)
    values, vectors = np.linalg.eigh(inverse[:, None] * still * inverse)
    stable = vectors[:, values > NULL].T * scale
    for j in range(3):
        part = stable @ modes[3 * n_u + j : 3 * n : 3]
        size = np.abs(part).max(initial=0.0)
        own = own + part.T @ part / (size**2 if size > 0 else 1.0)
    return own


def locking_ratio(hessian: Array, n_u: int, dim: int) -> float:
    r"""λ/μ that an isotropic body would need to resist volume change beside shear as this one does.

    With ε the strain along the axes of the mesh, at constant ν and ∇ν, κ = ε·Hε along ε = I/√d and
    s the least ε·Hε of all |ε| = 1, tr ε = 0: isotropy has κ = dλ + 2μ and s = 2μ, so that

    .. math:: \lambda/\mu = (2/d)\,(\kappa/s - 1).

    ν is kept, not relaxed: P1 fields ν cannot follow a tr ε that is constant on each cell, so what
    a volume change costs with ν at rest is what cells feel.

    Args:
        hessian: H of ρe, shape (samples, 4n, 4n), in the order of ``hessian.names``.
        n_u: Components of u.
        dim: Dimension d of the mesh.

    Returns:
        The largest ratio of the samples; 0 where nothing can lock: in 1D, if u has fewer components
        than the mesh dimensions, and without any shear stiffness (a fluid).
    """
    if dim < 2 or n_u < dim or not len(hessian):
        return 0.0
    rows = [3 * i + j for i in range(dim) for j in range(dim)]
    block = hessian[:, rows][:, :, rows]
    symmetric = []
    for i, j in itertools.combinations(range(dim), 2):
        shear = np.zeros((dim, dim))
        shear[i, j] = shear[j, i] = np.sqrt(0.5)
        symmetric.append(shear.ravel())
    for i in range(1, dim):
        tension = np.diag([1.0] * i + [-float(i)] + [0.0] * (dim - i - 1))
        symmetric.append((tension / np.linalg.norm(tension)).ravel())
    basis = np.array(symmetric).T
    volume = np.eye(dim).ravel() / np.sqrt(dim)
    kappa = np.einsum("i,mij,j->m", volume, block, volume)
    least = np.linalg.eigvalsh(basis.T @ block @ basis)[:, 0]
    solid = least > NULL * np.abs(kappa)
    ratios = 2.0 / dim * (kappa[solid] / least[solid] - 1.0)
    return float(ratios.max(initial=0.0))
