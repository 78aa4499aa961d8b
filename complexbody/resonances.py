# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Where asynchronous steps resonate, by formula and by plain matrices.

Two models in which plain asynchronous stepping (kicks, no dissipation) can be worked out: two
springs on one mass, in closed form, and a bar of two cell sizes, as a product of drifts and kicks.
Pure numpy: knows nothing of scenes, so that runs of the package can be measured against it.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

#: Growth per coarse step above which a point counts as unstable.
TOLERANCE = 1e-3
#: Cells of either size in the two-rate bar.
CELLS = 10


# --- two springs on one mass ----------------------------------------------------------------------


def two_springs(ratio: int, stiffness: float, omega: Array | float) -> Array:
    r"""Growth per step h₁ of a mass m on springs k₁ (step h₁ = n h₂) and k₂ (step h₂).

    With Ω = √(k₂/m) h₂, θ = 2 asin(Ω/2) and c = h₁h₂k₁/(m sin θ) the trace of the map over h₁ is
    2 cos nθ − c sin nθ.

    Args:
        ratio: n.
        stiffness: k₁/k₂.
        omega: Ω < 2.

    Returns:
        Spectral radius minus 1; 0 where stable. Same shape as ``omega``.
    """
    omega = np.asarray(omega, dtype=np.float64)
    theta = 2 * np.arcsin(0.5 * omega)
    c = ratio * omega**2 * stiffness / np.sin(theta)
    half = np.abs(np.cos(ratio * theta) - 0.5 * c * np.sin(ratio * theta))
    return np.where(half > 1, half + np.sqrt(np.maximum(half**2 - 1, 0.0)) - 1.0, 0.0)


@dataclass(frozen=True)
class Band:
    """An unstable interval of two springs: Ω from ``low`` to ``high``, growth per h₁ at its peak.

    Attributes:
        low, high: jπ − 2 atan(c/2) = nθ and nθ = jπ.
        peak: Ω of the largest growth in between; growth: |λ| − 1 there.
    """

    low: float
    high: float
    peak: float
    growth: float


def two_spring_bands(ratio: int, stiffness: float | None = None) -> list[Band]:
    """All bands of two springs below Ω = 2; k₁/k₂ = 1/n² by default (equal critical fractions).

    The map is unstable iff jπ − 2 atan(c/2) < nθ < jπ; at the peak |λ| is about c/2 + √(1 + c²/4).
    """
    k = 1.0 / ratio**2 if stiffness is None else stiffness
    bands = []
    for j in range(1, ratio):
        high = 2 * np.sin(0.5 * j * np.pi / ratio)

        def behind(omega: float, j: int = j) -> float:
            theta = 2 * np.arcsin(0.5 * omega)
            c = ratio * omega**2 * k / np.sin(theta)
            return float(ratio * theta - j * np.pi + 2 * np.arctan(0.5 * c))

        a, b = 2 * np.sin(0.5 * (j - 1) * np.pi / ratio) + 1e-12, high
        for _ in range(100):
            middle = 0.5 * (a + b)
            a, b = (middle, b) if behind(middle) < 0 else (a, middle)
        grid = np.linspace(b, high, 2001)
        growth = two_springs(ratio, k, grid)
        best = int(np.argmax(growth))
        bands.append(Band(float(b), float(high), float(grid[best]), float(growth[best])))
    return bands


# --- the two-rate bar -----------------------------------------------------------------------------


@lru_cache(maxsize=64)
def _bar(ratio: float) -> tuple[Array, Array]:
    """−M⁻¹K of the coarse and of the fine cells, lengths r and 1, c = 1; the first node is held.

    Shapes (2·CELLS, 2·CELLS); scaled so that a coarse cell's critical step is r, a fine one's 1.
    """
    lengths = np.array([ratio] * CELLS + [1.0] * CELLS)
    mass = np.zeros(2 * CELLS + 1)
    mass[:-1] += lengths / 2
    mass[1:] += lengths / 2
    parts = []
    for cells in (range(CELLS), range(CELLS, 2 * CELLS)):
        K = np.zeros((2 * CELLS + 1,) * 2)
        for i in cells:
            K[i : i + 2, i : i + 2] += np.array([[1.0, -1.0], [-1.0, 1.0]]) / lengths[i]
        parts.append(-(K / mass[:, None])[1:, 1:])
    return parts[0], parts[1]


def two_rate_map(ratio: float, counts: tuple[int, int], alphas: Array) -> Array:
    """q after a period as a function of q before, at q̇ = 0: drifts and kicks one by one.

    Args:
        ratio: Coarse over fine cell length r.
        counts: Steps (N_c, N_f) of coarse and fine cells per period.
        alphas: Coarse step over its critical one, shape (a,); the period is N_c α r.

    Returns:
        Shape (a, 2·CELLS, 2·CELLS).
    """
    coarse, fine = _bar(float(ratio))
    period = np.asarray(alphas, dtype=np.float64)[:, None, None] * ratio * counts[0]
    q = np.tile(np.eye(len(coarse)), (len(period), 1, 1))
    v = np.zeros_like(q)
    times = sorted({Fraction(j, N) for N in counts for j in range(N + 1)})
    for t, after in itertools.pairwise(times):
        acting = [
            A / N for A, N in ((coarse, counts[0]), (fine, counts[1])) if (t * N).denominator == 1
        ]
        v = v + (0.5 if t == 0 else 1.0) * period * (sum(acting) @ q)
        q = q + float(after - t) * period * v
    return q


def two_rate_growth(ratio: float, counts: tuple[int, int], alphas: Array) -> Array:
    """Spectral radius of a period's map, minus 1, per coarse step, shape (a,).

    The order of events is the same backwards in time, so that the inverse of the map
    [[A, B], [C, D]] is [[A, −B], [−C, D]], and λ + 1/λ = 2μ with μ an eigenvalue of A.
    """
    mu = np.linalg.eigvals(two_rate_map(ratio, counts, alphas)).astype(np.complex128)
    root = np.sqrt(mu**2 - 1)
    radius = np.maximum(np.abs(mu + root), np.abs(mu - root)).max(axis=1)
    return radius ** (1.0 / counts[0]) - 1.0


def window_counts(ratio: float) -> tuple[int, int]:
    """(N_c, N_f) of plain windows on cells of size ratio r: the fine ones make ⌈r⌉ steps."""
    return 1, int(np.ceil(ratio * (1 - 1e-12)))


def real_counts(ratio: Fraction) -> tuple[int, int]:
    """(N_c, N_f) over the common period of real steps, r = N_f/N_c."""
    return ratio.denominator, ratio.numerator


def resonance_free(ratio: float) -> float:
    """α below which a bar of steps r to 1 has no resonance: sin(π/2r).

    A mode of the fine cells of frequency 2 asin(α)/h_f at most would have to swing by π in h_c.
    """
    return float(np.sin(0.5 * np.pi / ratio))


@lru_cache(maxsize=256)
def first_unstable(ratio: int, limit: float = 1.0) -> tuple[float, float]:
    """Smallest α ≤ ``limit`` at which a bar of steps r to 1 grows by over 1e-3 per coarse step.

    Bands are looked for every 2.5e-4 of α; thinner ones are missed.

    Returns:
        That α and the largest growth at any α ≤ ``limit``; (inf, 0) if there is no band.
    """
    alphas = np.arange(resonance_free(ratio), limit + 1e-12, 2.5e-4)
    if not len(alphas):
        return np.inf, 0.0
    growth = two_rate_growth(ratio, (1, ratio), alphas)
    found = np.flatnonzero(growth > TOLERANCE)
    return (float(alphas[found[0]]), float(growth.max())) if len(found) else (np.inf, 0.0)
