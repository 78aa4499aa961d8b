# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Plane waves on uniform meshes follow the exact discrete dispersion relation, to round-off.

Intervals, right triangles and Kuhn's tetrahedra form lattices: every node sees the same stencil. So
Re(a e^{iq·x}) cos ωt, with K_h(q)a = λM a and sin²(ωh/2) = h²λ/4, is a solution of the lumped P1
scheme itself (K_h is Hermitian and K_h(−q) its conjugate). Here it is prescribed on the boundary
and started inside, where it must then go on.
"""

import numpy as np
import pytest
import scipy.linalg
from dense import prepared, state, whole
from verification.lattice import chiral, lattice_mesh, lattice_stiffness

import complexbody as cb
from complexbody.forms import (
    hexagonal_quasicrystal,
    isotropic_two_field,
    scaled_icosahedral_quasicrystal,
)

SCALED = {"C44": 1.0, "K2": 0.6, "R3": 0.4, "density": 1.0, "inertia": 0.8, "viscosity": 0.0}
CASES = {
    "two fields of 1, 1D": ((16,), isotropic_two_field(d=1)),
    "two fields of 2, 1D": ((16,), isotropic_two_field(d=2, inertia=0.6)),
    "two fields of 3, 1D": ((16,), isotropic_two_field(d=3, density=1.4)),
    "chiral, 1D": ((16,), chiral(1)),
    "antiplane, 2D": ((9, 7), hexagonal_quasicrystal(**SCALED)),
    "two fields of 2, 2D": ((9, 7), isotropic_two_field(d=2, inertia=0.6)),
    "chiral, 2D": ((9, 7), chiral(2)),
    "icosahedral, 2D": ((9, 7), scaled_icosahedral_quasicrystal(viscosity=0.0)),
    "antiplane, 3D": ((6, 5, 4), hexagonal_quasicrystal(**SCALED)),
    "two fields of 3, 3D": ((6, 5, 4), isotropic_two_field(d=3, density=1.4)),
    "icosahedral, 3D": ((6, 5, 4), scaled_icosahedral_quasicrystal(viscosity=0.0)),
}


@pytest.mark.parametrize("branch", ["slowest", "fastest"])
@pytest.mark.parametrize("self_action", ["consistent", "lumped"])
@pytest.mark.parametrize("case", CASES)
def test_plane_wave(comm, case, self_action, branch):
    cells, body = CASES[case]
    dim, sides = len(cells), np.array([1.0, 0.8, 0.7])[: len(cells)]
    mesh = lattice_mesh(comm, sides, cells)
    size, q = sides / cells, np.array([4.1, -5.3, 3.2])[:dim]
    n_u, n = body.displacement, body.components
    stiff = lattice_stiffness(body, size, q, self_action == "lumped")
    assert abs(stiff - stiff.conj().T).max() < 1e-13 * abs(stiff).max()
    assert (abs(stiff.imag).max() > 0.01 * abs(stiff).max()) == case.startswith("chiral")
    mass = np.prod(size) * np.repeat([body.density, body.inertia], [n_u, n - n_u])
    squares, modes = scipy.linalg.eigh(stiff, np.diag(mass))
    number = 0 if branch == "slowest" else -1
    assert squares[0] > 0
    a = modes[:, number] / abs(modes[:, number]).max()

    def shape(rows):
        return lambda x: np.real(a[rows, None] * np.exp(1j * (q @ x[:dim] + 0.3)))

    u, nu = slice(0, n_u), slice(n_u, n)
    # ω depends on h, and h on the body alone.
    free = cb.Scene(mesh, body, self_action=self_action)
    h = prepared(free, cb.Synchronous(safety=0.9)).step
    omega = 2 / h * np.arcsin(0.5 * h * np.sqrt(squares[number]))
    assert omega * h > (0.02 if branch == "slowest" else 0.2), "a static test says nothing"
    swing = cb.sine(omega / (2 * np.pi), np.pi / 2)
    scene = cb.Scene(
        mesh,
        body,
        [cb.Fix("u", "boundary", shape(u), history=swing),
         cb.Fix("nu", "boundary", shape(nu), history=swing)],
        initial=cb.Initial(shape(u), shape(nu)),
        self_action=self_action,
    )  # fmt: skip
    run = prepared(scene, cb.Synchronous(h))
    points, _ = whole(mesh)
    inside = np.all((points > 1e-9) & (points < sides - 1e-9), axis=1)
    assert inside.sum() >= 15
    wave = shape(slice(0, n))(points.T).T
    for steps in (1, 24, 75):
        run.advance(steps)
        field, rate = state(run)
        assert abs(field - np.cos(omega * run.time) * wave).max() < 1e-10
        # The rate is the mean of both drifts: a central difference of the cosine.
        central = -np.sin(omega * run.time) * np.sin(omega * h) / h * wave
        assert abs(rate - central)[inside].max() < 1e-10 * omega
