# SPDX-License-Identifier: LGPL-3.0-or-later
"""Case 4: voids in magnesium oscillate thousands of times faster than waves cross a cell."""

import numpy as np
import pytest
import scipy.linalg
from harness import largest, refused
from verification.stiff_bars import bar, start

import complexbody as cb
from complexbody.errors import StepError
from complexbody.forms import elastic_voids
from complexbody.problem import Problem
from complexbody.timesets import critical_step


def test_time_scales(comm):
    """Cells of 1 mm, u and ν apart: critical steps 2.9e-11 s and 1.4e-7 s, and no way between."""
    body = elastic_voids(d=1, b=0.0)
    lumped, stepped_over = (
        bar(comm, body, 40, 0.04, self_action=action) for action in ("lumped", "implicit")
    )
    optical, acoustic = (critical_step(Problem(scene)) for scene in (lumped, stepped_over))
    assert optical == pytest.approx(2 / np.sqrt(body.constants["xi"] / body.inertia), rel=1e-3)
    assert optical == pytest.approx(2.88e-11, rel=0.01)
    modulus = body.constants["lambda_"] + 2 * body.constants["mu"]
    assert acoustic == pytest.approx(1e-3 / np.sqrt(modulus / body.density), rel=1e-6)
    assert acoustic / optical == pytest.approx(4900, rel=0.02)
    with refused(StepError, "critical"):
        cb.simulate(lumped, cb.Synchronous(acoustic), until=10 * acoustic)


def test_magnesium_with_voids(comm):
    """Millimetre cells at more than 1000 times the optical step; the slow wave within 1 %."""
    body, length = elastic_voids(d=1), 0.04
    c = body.constants
    q = np.pi / length
    modulus = c["lambda_"] + 2 * c["mu"]
    stiff = np.array([[modulus * q**2, c["b"] * q], [c["b"] * q, c["alpha"] * q**2 + c["xi"]]])
    values, vectors = scipy.linalg.eigh(stiff, np.diag([body.density, body.inertia]))
    omega, share = np.sqrt(values[0]), vectors[1, 0] / vectors[0, 0]
    assert omega < 0.97 * q * np.sqrt(modulus / body.density)  # voids soften it
    scene = bar(comm, body, 40, length, initial=start(share, length))
    until = 1.75 * 2 * np.pi / omega
    result = cb.simulate(scene, cb.Synchronous(), until=until)
    optical = 2 / np.sqrt(c["xi"] / body.inertia)
    assert result.stats.step > 1000 * optical
    x = scene.mesh.geometry.x[:, 0]
    # At a quarter period the error of u is that of the phase.
    assert largest(comm, result.u.x.array) < 0.01 * 2 * np.pi * 1.75
    exact = -omega * np.sin(omega * until) * np.sin(np.pi * x / length)
    assert largest(comm, result.u_dot.x.array - exact) < 0.01 * omega
    wrong = cb.simulate(
        bar(comm, elastic_voids(d=1, b=0.0), 40, length, initial=start(0.0, length)),
        cb.Synchronous(), until=until,
    )  # fmt: skip
    assert largest(comm, wrong.u.x.array) > 0.1
