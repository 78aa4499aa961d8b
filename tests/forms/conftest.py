# SPDX-License-Identifier: LGPL-3.0-or-later
"""Energies as numbers: evaluated at constant tensors and differentiated by polarisation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import ufl


def _value(energy: Any, U: Any, nu: Any, N: Any) -> float:
    """The energy at constant U, ν, N, arrays of shapes (n_u, 3), (k,), (k, 3)."""
    U, nu, N = (ufl.as_tensor(np.asarray(a, dtype=float).tolist()) for a in (U, nu, N))
    return float(energy(U, nu, N))


def _basis(n_u: int, k: int, d: int, use_nu: bool) -> list[tuple[Any, Any, Any]]:
    """A basis of (sym U, ν, N), or (U, ν, N) if n_u ≠ d, with columns beyond d zero."""
    states = []

    def add(part: int, *entries: tuple[int, ...]) -> None:
        state = (np.zeros((n_u, 3)), np.zeros(k), np.zeros((k, 3)))
        for entry in entries:
            state[part][entry] = 1.0 / len(entries)
        states.append(state)

    for i in range(n_u):
        for j in range(d):
            if n_u != d or i == j:
                add(0, (i, j))
            elif i < j:
                add(0, (i, j), (j, i))
    for i in range(k):
        if use_nu:
            add(1, (i,))
        for j in range(d):
            add(2, (i, j))
    return states


def _hessian(energy: Any, n_u: int, k: int, d: int = 3, use_nu: bool = False) -> np.ndarray:
    """H of a quadratic form e(x) = ½x·Hx: H_ij = e(x_i + x_j) − e(x_i) − e(x_j)."""
    basis = _basis(n_u, k, d, use_nu)
    single = [_value(energy, *x) for x in basis]
    H = np.diag(2.0 * np.array(single))
    for i, x in enumerate(basis):
        for j in range(i):
            together = _value(energy, *(a + b for a, b in zip(x, basis[j], strict=True)))
            H[i, j] = H[j, i] = together - single[i] - single[j]
    c = np.random.default_rng(0).normal(size=len(basis))
    x = [sum(a * state[part] for a, state in zip(c, basis, strict=True)) for part in range(3)]
    # ... and it is quadratic: otherwise polarisation would mean nothing
    np.testing.assert_allclose(_value(energy, *x), 0.5 * c @ H @ c, rtol=1e-9)
    return H


def _lowest(H: np.ndarray) -> float:
    """The smallest eigenvalue of H with its diagonal scaled to ±1: its sign has no units."""
    s = 1.0 / np.sqrt(np.maximum(np.abs(np.diag(H)), 1e-300 + 1e-14 * np.abs(H).max()))
    return float(np.linalg.eigvalsh(H * np.outer(s, s)).min())


@pytest.fixture(scope="session")
def value() -> Callable[..., float]:
    """``value(energy, U, nu, N)``: an energy density at constant tensors."""
    return _value


@pytest.fixture(scope="session")
def hessian() -> Callable[..., np.ndarray]:
    """``hessian(energy, n_u, k, d=3, use_nu=False)`` by polarisation."""
    return _hessian


@pytest.fixture(scope="session")
def lowest() -> Callable[[np.ndarray], float]:
    """``lowest(H)``: the smallest eigenvalue of H scaled to a unit diagonal."""
    return _lowest
