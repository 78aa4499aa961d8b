# SPDX-License-Identifier: LGPL-3.0-or-later
"""Dispersion curves of a body: frequency, decay and phase speed of its waves in one direction.

Branches are followed from one wave number to the next, so that each keeps its colour. Draws what
:meth:`complexbody.body.Body.dispersion` says, and computes nothing else.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from complexbody.body import Body
from complexbody.errors import BodyError

Array = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]
#: Frequencies below this share of the largest are zero, and speeds of theirs not drawn.
STILL = 1e-9
#: Decay below this share of the largest frequency is round-off.
ROUND_OFF = 1e-12
#: Part of the first step in which branches are told apart.
NEAR = 1e-3


def branches(body: Body, direction: Any, q: Array, **state: Any) -> Complex:
    """ω of waves along a direction, each column one branch followed in q.

    Args:
        body: The body.
        direction: 1 to 3 components, of any length but zero.
        q: Wave numbers [1/m], shape (m,).
        state: As for :meth:`~complexbody.body.Body.dispersion`.

    Returns:
        ω [rad/s], shape (m, b), b as for ``dispersion``.

    Raises:
        BodyError: for a direction or wave numbers that are none, or as ``dispersion``.
    """
    along = np.atleast_1d(np.asarray(direction, dtype=np.float64))
    if along.ndim != 1 or not (np.isfinite(along).all() and along.any()):
        raise BodyError(
            f"plot_dispersion: direction is {direction!r}. Give 1 to 3 numbers, not all zero."
        )
    if q.ndim != 1 or len(q) < 2 or not np.isfinite(q).all() or not (np.diff(q) > 0).all():
        raise BodyError(
            "plot_dispersion: q is no increasing array of two or more finite numbers. Give for "
            "instance numpy.linspace(0, 100, 200), in 1/m."
        )
    along = along / np.linalg.norm(along)
    omega = body.dispersion(q[:, None] * along, **state)
    # Straight on, so that branches cross; at the start by slopes over a small part of a step.
    little = NEAR * (q[1] - q[0])
    next_to = body.dispersion((q[0] + little) * along, **state)
    omega[0] = _matched(next_to, omega[0])
    slope = (next_to - omega[0]) / little
    for row in range(1, len(q)):
        step = q[row] - q[row - 1]
        omega[row] = _matched(omega[row - 1] + step * slope, omega[row])
        slope = (omega[row] - omega[row - 1]) / step
    return omega


def _matched(guess: Complex, found: Complex) -> Complex:
    """Values in the order in which they are nearest to those guessed."""
    return np.asarray(found[linear_sum_assignment(np.abs(guess[:, None] - found))[1]])


def plot_dispersion(
    body: Body, q: Any, direction: Any = (1.0,), path: str | Path | None = None,
    axes: Any = None, **state: Any,
) -> Any:  # fmt: skip
    """Draw Re ω, −Im ω and the phase speed Re ω/q of a body's plane waves against wave number.

    Waves that do not oscillate show in the panel of decay alone. Rates of decay have a logarithmic
    axis where they are decades apart.

    Args:
        body: The body.
        q: Increasing wave numbers [1/m], shape (m,).
        direction: Of the wave vector, 1 to 3 components.
        path: File for the picture, PNG, PDF or what else matplotlib can write.
        axes: Three matplotlib axes to draw into, instead of a figure of its own.
        state: u, U, nu, N, as for :meth:`complexbody.body.Body.dispersion`.

    Returns:
        The three axes.

    Raises:
        BodyError: as :func:`branches`, or for axes that are not three.
    """
    q = np.asarray(q, dtype=np.float64)
    omega = branches(body, direction, q, **state)
    if axes is not None and np.size(axes) != 3:
        raise BodyError(f"plot_dispersion: axes are {np.size(axes)}. Give three, or none.")
    if axes is not None:
        _draw(np.ravel(axes), q, omega)
        if path is not None:
            np.ravel(axes)[0].figure.savefig(path, dpi=130)
        return axes
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.6, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3)
    _draw(axes, q, omega)
    named = ", ".join(f"{x:g}" for x in np.atleast_1d(direction))
    figure.suptitle(f"{body.name}: plane waves along ({named})", x=0.01, ha="left")
    if path is not None:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=130)
    return axes


def _draw(axes: Any, q: Array, omega: Complex) -> None:
    import matplotlib

    size, decay = np.abs(omega).max(), -omega.imag
    moving = omega.real > STILL * size
    with np.errstate(divide="ignore", invalid="ignore"):
        speed = np.where(moving & (q[:, None] > 0), omega.real / q[:, None], np.nan)
    colours = [matplotlib.colormaps["tab10"](i) for i in range(10)]
    seen = np.nanmax(decay, initial=0.0) > ROUND_OFF * size
    rates = decay[-1][decay[-1] > ROUND_OFF * size]
    apart = seen and decay.min() >= -ROUND_OFF * size and len(rates) > 0
    log = apart and rates.max() > 1e3 * rates.min()
    if log:  # nothing to be seen of waves that do not decay
        decay = np.where(decay > ROUND_OFF * size, decay, np.nan)
    # Of a pair ±Re ω one is drawn, where it moves; decay, which may split it in two, of both.
    last = omega[-1]
    forward = np.flatnonzero(last.real >= -STILL * size)
    for b in range(omega.shape[1]):
        distance = np.abs(last[forward] + last[b].conj())
        own = int(np.argmin(np.where(forward == b, -1.0, distance)))
        # Branches that coincide: the first drawn is the widest.
        width = 1.2 + 2.4 * (1 - own / len(forward))
        style = {"color": colours[own % 10], "lw": width}
        axes[0].plot(q, np.where(moving[:, b], omega[:, b].real, np.nan), **style)
        if seen:
            axes[1].plot(q, decay[:, b], **style)
        axes[2].plot(q, speed[:, b], **style)
    titles = ("frequency Re ω [rad/s]", "decay −Im ω [1/s]", "phase speed Re ω/q [m/s]")
    for ax, title in zip(axes, titles, strict=True):
        ax.set_xlabel("wave number q [1/m]")
        ax.set_ylabel(title)
        ax.set_xlim(q[0], q[-1])
        ax.grid(True, lw=0.5, color="0.88")
        ax.set_axisbelow(True)
        for side in ("top", "right"):
            ax.spines[side].set_visible(False)
    axes[0].set_ylim(bottom=0.0)
    if not seen:
        axes[1].text(0.5, 0.5, "no wave decays", ha="center", transform=axes[1].transAxes)
        axes[1].set_yticks([])
    elif log:
        axes[1].set_yscale("log")
    fast = np.nanpercentile(speed, 90) if np.isfinite(speed).any() else np.nan
    end = np.nanmax(speed[-1]) if np.isfinite(speed[-1]).any() else np.nan
    top = np.nanmax([fast, end, -np.inf])
    if np.isfinite(top) and np.nanmax(speed) > 3 * top:  # optical branches: infinite at q = 0
        axes[2].set_ylim(0.0, 2 * top)
    elif np.isfinite(top):
        axes[2].set_ylim(bottom=0.0)
