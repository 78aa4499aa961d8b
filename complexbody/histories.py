# SPDX-License-Identifier: LGPL-3.0-or-later
"""Histories: how loads and moving supports depend on time.

A history is a frozen object called with a time or an array of times [s] and returns the factor
(dimensionless) by which the load's vector or the support's value is multiplied.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from complexbody.errors import SceneError
from complexbody.given import is_finite, is_number, is_positive, numbers, short


class History(Protocol):
    """Anything that maps times to factors, elementwise."""

    def __call__(self, t: Any) -> Any:
        """The factor at the times ``t`` [s], of the same shape."""


def _positive(where: str, **values: Any) -> None:
    for name, value in values.items():
        if not is_positive(value):
            raise SceneError(f"{where}: {name} is {short(value)}. Give a positive {name}.")


def _finite(where: str, **values: Any) -> None:
    for name, value in values.items():
        if not is_finite(value):
            raise SceneError(f"{where}: {name} is {short(value)}. Give a finite {name}.")


@dataclass(frozen=True)
class Constant:
    """The factor 1 at all times."""

    def __call__(self, t: Any) -> Any:
        """1, of the shape of ``t``."""
        return np.ones_like(np.asarray(t, dtype=np.float64))


@dataclass(frozen=True)
class Ricker:
    r"""Ricker wavelet :math:`(1 - 2a)e^{-a}`, :math:`a = \pi^2f^2(t - t_0)^2` (Ricker 1953)."""

    frequency: float
    delay: float

    def __call__(self, t: Any) -> Any:
        """The factor at the times ``t`` [s]."""
        a = (np.pi * self.frequency * (np.asarray(t, dtype=np.float64) - self.delay)) ** 2
        return (1.0 - 2.0 * a) * np.exp(-a)


@dataclass(frozen=True)
class Ramp:
    """0 before ``start``, smooth (C², quintic) to 1 over ``duration``, then 1."""

    duration: float
    start: float = 0.0

    def __call__(self, t: Any) -> Any:
        """The factor at the times ``t`` [s]."""
        s = np.clip((np.asarray(t, dtype=np.float64) - self.start) / self.duration, 0.0, 1.0)
        return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


@dataclass(frozen=True)
class Step:
    """0 before ``start``, 1 from ``start`` on, until ``end`` (exclusive)."""

    start: float = 0.0
    end: float = np.inf

    def __call__(self, t: Any) -> Any:
        """The factor at the times ``t`` [s]."""
        t = np.asarray(t, dtype=np.float64)
        return np.where((t >= self.start) & (t < self.end), 1.0, 0.0)


@dataclass(frozen=True)
class Sine:
    """sin(2πft + phase) [phase in radians]."""

    frequency: float
    phase: float = 0.0

    def __call__(self, t: Any) -> Any:
        """The factor at the times ``t`` [s]."""
        return np.sin(2 * np.pi * self.frequency * np.asarray(t, dtype=np.float64) + self.phase)


@dataclass(frozen=True)
class Table:
    """Linear between given points, constant outside them."""

    times: tuple[float, ...]
    values: tuple[float, ...]

    def __call__(self, t: Any) -> Any:
        """The factor at the times ``t`` [s]."""
        return np.interp(np.asarray(t, dtype=np.float64), self.times, self.values)


@dataclass(frozen=True)
class Shifted:
    """Another history, seen from ``start`` [s]: its factor at start + t."""

    history: History
    start: float

    def __call__(self, t: Any) -> Any:
        """The factor at the times ``t`` [s] after the start."""
        return self.history(np.asarray(t, dtype=np.float64) + self.start)


def shifted(history: History, start: float) -> History:
    """A history whose time 0 is ``start`` [s] of what it was before any shift."""
    if isinstance(history, Constant):
        return history
    return Shifted(history.history if isinstance(history, Shifted) else history, float(start))


def constant() -> Constant:
    """The factor 1 at all times."""
    return Constant()


def ricker(frequency: float, delay: float | None = None) -> Ricker:
    """Ricker wavelet of peak ``frequency`` [Hz], centred at ``delay`` [s] (default 1.5/frequency).

    Raises:
        SceneError: if the frequency is not positive, or the delay not finite.
    """
    _positive("ricker", frequency=frequency)
    _finite("ricker", delay=0.0 if delay is None else delay)
    return Ricker(float(frequency), 1.5 / frequency if delay is None else float(delay))


def ramp(duration: float, start: float = 0.0) -> Ramp:
    """Smooth rise from 0 to 1 over ``duration`` [s] from ``start`` [s] on.

    Raises:
        SceneError: if the duration is not positive, or the start not finite.
    """
    _positive("ramp", duration=duration)
    _finite("ramp", start=start)
    return Ramp(float(duration), float(start))


def step(start: float = 0.0, end: float = np.inf) -> Step:
    """1 from ``start`` [s] to ``end`` [s], else 0.

    Raises:
        SceneError: if the end is not after the start.
    """
    if not (is_number(start) and is_number(end) and end > start):
        raise SceneError(
            f"step: end {short(end)} is not after start {short(start)}. Give end > start."
        )
    return Step(float(start), float(end))


def sine(frequency: float, phase: float = 0.0) -> Sine:
    """sin(2π·frequency·t + phase), frequency in Hz.

    Raises:
        SceneError: if the frequency is not positive, or the phase not finite.
    """
    _positive("sine", frequency=frequency)
    _finite("sine", phase=phase)
    return Sine(float(frequency), float(phase))


def table(times: Sequence[float], values: Sequence[float]) -> Table:
    """Linear interpolation of measured values; constant before the first and after the last.

    Raises:
        SceneError: if the lengths differ, or the times do not increase, or a value is not finite.
    """
    t, v = numbers(times), numbers(values)
    if t is None or v is None:
        raise SceneError("table: times or values are no numbers. Give two lists of numbers.")
    if t.ndim != 1 or t.shape != v.shape or t.size == 0:
        raise SceneError(
            f"table: times have shape {t.shape} and values {v.shape}. Give two lists of one length."
        )
    if not (np.all(np.isfinite(t)) and np.all(np.isfinite(v)) and np.all(np.diff(t) > 0)):
        raise SceneError("table: times must increase and be finite, as must values. Sort them.")
    return Table(tuple(t.tolist()), tuple(v.tolist()))
