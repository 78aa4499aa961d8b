# SPDX-License-Identifier: LGPL-3.0-or-later
"""Factors of time: values, arrays, equality, and what is refused."""

import dataclasses

import numpy as np
import pytest
from harness import refused

import complexbody as cb
from complexbody.errors import SceneError

EVERY = {
    "constant": cb.constant(),
    "ricker": cb.ricker(2.0),
    "ramp": cb.ramp(0.5, start=0.25),
    "step": cb.step(0.25, 0.75),
    "sine": cb.sine(2.0, phase=0.3),
    "table": cb.table([0.0, 0.5, 1.0], [1.0, -1.0, 0.5]),
}


@pytest.mark.parametrize("name", EVERY)
def test_shapes_and_equality(name):
    """A time, arrays of times of any shape; frozen, equal to a copy: runs share load groups."""
    history = EVERY[name]
    times = np.linspace(-0.5, 1.5, 12).reshape(3, 4)
    table = history(times)
    assert table.shape == (3, 4)
    for index in np.ndindex(3, 4):
        assert float(history(times[index])) == table[index]
    assert dataclasses.replace(history) == history
    assert {history: 1}[dataclasses.replace(history)] == 1
    assert sum(history == other for other in EVERY.values()) == 1
    for field in dataclasses.fields(history):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(history, field.name, 0.0)


def test_constant():
    assert np.array_equal(cb.constant()(np.array([-1.0, 0.0, 7.0])), [1.0, 1.0, 1.0])


def test_ricker():
    """Peak 1 at the delay (1.5 periods by default), zeros at ±1/(√2 π f), no mean value."""
    history = cb.ricker(2.0)
    assert float(history(0.75)) == 1.0
    assert float(history(0.75 + 1 / (np.sqrt(2) * np.pi * 2))) == pytest.approx(0.0, abs=1e-15)
    assert float(cb.ricker(2.0, delay=0.1)(0.1)) == 1.0
    assert abs(float(history(0.0))) < 1e-8  # a start from rest
    t = np.linspace(-3, 5, 20001)
    assert abs(history(t).sum() * (t[1] - t[0])) < 1e-12  # nothing at the ends
    # Its spectrum peaks at f.
    spectrum = np.abs(np.fft.rfft(history(t)))
    assert np.fft.rfftfreq(len(t), t[1] - t[0])[spectrum.argmax()] == pytest.approx(2.0, abs=0.13)


def test_ramp():
    """From 0 to 1, its first two derivatives continuous, symmetric about its middle."""
    history = cb.ramp(0.5, start=0.25)
    assert history(np.array([-1.0, 0.25, 0.5, 0.75, 9.0])) == pytest.approx([0, 0, 0.5, 1, 1])
    t = np.linspace(0.25, 0.75, 1001)
    assert np.all(np.diff(history(t)) > 0)
    np.testing.assert_allclose(history(t) + history(1.0 - t), 1.0, atol=1e-14)
    for edge in (0.25, 0.75):
        h = 1e-4
        f = history(edge + h * np.arange(-2, 3))
        assert abs(f[3] - f[1]) / (2 * h) < 1e-5
        assert abs(f[3] - 2 * f[2] + f[1]) / h**2 < 0.1  # jumps by 240 if only C¹


def test_step():
    """The start belongs to it, the end does not."""
    history = cb.step(0.25, 0.75)
    assert np.array_equal(history(np.array([0.2, 0.25, 0.5, 0.75])), [0, 1, 1, 0])
    assert np.array_equal(cb.step()(np.array([-1e-9, 0.0, 1e9])), [0, 1, 1])


def test_sine():
    assert float(cb.sine(2.0)(0.125)) == pytest.approx(1.0)
    assert float(cb.sine(2.0, phase=np.pi / 2)(0.0)) == pytest.approx(1.0)
    assert float(cb.sine(2.0)(0.5)) == pytest.approx(0.0, abs=1e-14)


def test_table():
    """Linear between the points, constant outside."""
    history = cb.table([0.0, 0.5, 1.0], [1.0, -1.0, 0.5])
    assert history(np.array([-1, 0, 0.25, 0.5, 0.9, 1, 2])) == pytest.approx(
        [1, 1, 0, -1, 0.2, 0.5, 0.5]
    )
    assert float(cb.table([3.0], [2.0])(7.0)) == 2.0


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: cb.ricker(0.0), ("ricker", "frequency", "0.0")),
        (lambda: cb.ricker(-1.0), ("ricker", "frequency", "-1.0")),
        (lambda: cb.ricker("2 MHz"), ("ricker", "frequency", "2 MHz")),
        (lambda: cb.ricker(1.0, delay=np.nan), ("ricker", "delay", "nan")),
        (lambda: cb.ramp(0.0), ("ramp", "duration")),
        (lambda: cb.ramp(np.inf), ("ramp", "duration", "inf")),
        (lambda: cb.ramp(1.0, start=np.inf), ("ramp", "start", "inf")),
        (lambda: cb.step(1.0, 1.0), ("step", "end", "start")),
        (lambda: cb.step(np.nan), ("step", "nan")),
        (lambda: cb.sine(np.nan), ("sine", "frequency", "nan")),
        (lambda: cb.sine(1.0, phase=np.nan), ("sine", "phase", "nan")),
        (lambda: cb.table([0, 1], [0]), ("table", "(2,)", "(1,)")),
        (lambda: cb.table([], []), ("table", "(0,)")),
        (lambda: cb.table([[0, 1]], [[0, 1]]), ("table", "(1, 2)")),
        (lambda: cb.table([0, 0], [0, 1]), ("table", "increase")),
        (lambda: cb.table([1, 0], [0, 1]), ("table", "increase")),
        (lambda: cb.table([0, 1], [0, np.nan]), ("table", "finite")),
    ],
)
def test_refused(make, words):
    with refused(SceneError, *words):
        make()
