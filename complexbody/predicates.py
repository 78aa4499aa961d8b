# SPDX-License-Identifier: LGPL-3.0-or-later
"""Where a user's predicate of positions holds, and what is wrong with it if it does not work."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from complexbody.errors import SceneError


def mask(what: str, where: Any, x: Any) -> tuple[npt.NDArray[np.bool_], Exception | None]:
    """Where a user's predicate holds at points x (3, npts); nowhere if it fails, and why."""
    none = np.zeros(x.shape[1], np.bool_)
    if not x.shape[1]:
        return none, None  # ranks without points have nothing to ask
    try:
        found = np.asarray(where(x))
    except Exception as error:  # a user's callable may fail in any way
        return none, SceneError(
            f"{what}: the predicate cannot be evaluated: {type(error).__name__}: {error}. Give a "
            "function of x (3, npts) -> bool (npts,)."
        )
    if found.shape != none.shape:
        return none, SceneError(
            f"{what}: the predicate returned shape {found.shape} for {x.shape[1]} points. Return "
            "one truth value per column of x."
        )
    if found.dtype.kind not in "biu":
        return none, SceneError(
            f"{what}: the predicate returned values of type {found.dtype}, no truth values. Return "
            "one truth value per column of x."
        )
    return found.astype(np.bool_), None
