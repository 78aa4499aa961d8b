# SPDX-License-Identifier: LGPL-3.0-or-later
"""What users give where a number, a count or a flag is meant: questions, and values in messages.

Python and NumPy convert much without a word (texts, truth values, complex numbers); here they do
not. Knows nothing else of complexbody.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

#: Letters of a value in a message.
LONGEST = 100


def is_number(value: Any) -> bool:
    """Whether this is a real number (truth values are none)."""
    real = int | float | np.integer | np.floating
    return isinstance(value, real) and not isinstance(value, bool)


def is_finite(value: Any) -> bool:
    """Whether this is a number that a float can hold."""
    try:
        return is_number(value) and math.isfinite(value)
    except OverflowError:  # an integer of hundreds of digits
        return False


def is_positive(value: Any) -> bool:
    """Whether this is a finite number > 0."""
    return is_finite(value) and value > 0


def is_whole(value: Any) -> bool:
    """Whether this is a whole number of the machine's."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    return whole and -(2**63) <= value < 2**63


def is_flag(value: Any) -> bool:
    """Whether this is True or False."""
    return isinstance(value, bool | np.bool_)


def is_path(value: Any) -> bool:
    """Whether this can be the name of a file or folder."""
    return isinstance(value, str | Path) and str(value) != "" and "\0" not in str(value)


def numbers(value: Any) -> npt.NDArray[np.float64] | None:
    """An array of real numbers as floats, whatever its shape; None if it is none."""
    try:
        array = np.asarray(value)
    except Exception:  # rows of several lengths, or an object that cannot be an array
        return None
    if array.dtype.kind not in "iuf" or isinstance(value, np.ma.MaskedArray):
        return None
    return array.astype(np.float64)


def finite(value: Any) -> npt.NDArray[np.float64] | None:
    """An array of finite numbers as floats, whatever its shape; None if it is none."""
    array = numbers(value)
    return array if array is not None and np.all(np.isfinite(array)) else None


def short(value: Any) -> str:
    """A value in a message: its text, cut where it is long."""
    try:
        text = repr(value)
    except Exception:  # of an object that has none, or too many digits
        text = f"a {type(value).__name__}"
    return text if len(text) <= LONGEST else text[: LONGEST - 1] + "…"
