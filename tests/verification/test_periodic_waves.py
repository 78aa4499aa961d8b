# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Plane waves in periodic boxes: no boundary takes part, whatever the direction.

With opposite faces one, every node of a lattice sees the same stencil, and Re(a e^{i(q·x − ωt)})
with K_h(q)a = λM a and sin²(ωh/2) = h²λ/4 runs for ever if the box holds whole wavelengths. The
step is chosen such that ωh = 2π/N: after N steps it is where it began.
"""

import numpy as np
import pytest
import scipy.linalg
from dense import prepared, values, whole
from harness import largest
from verification.lattice import chiral, lattice_stiffness

import complexbody as cb
from complexbody import meshes
from complexbody.forms import isotropic_two_field, scaled_icosahedral_quasicrystal
from complexbody.problem import Problem
from complexbody.timesets import critical_step

SIDES = np.array([1.0, 0.8, 0.7])
ICOSAHEDRAL = scaled_icosahedral_quasicrystal(viscosity=0.0)
CASES = {  # cells, body, waves in the box along each axis
    "two fields, 1D": ((12,), isotropic_two_field(d=1, inertia=0.6), [(1,), (3,)]),
    "chiral, 1D": ((12,), chiral(1), [(-2,)]),
    "two fields, 2D": ((7, 6), isotropic_two_field(d=2, inertia=0.6), [(1, 0), (2, -1), (0, 2)]),
    "chiral, 2D": ((7, 6), chiral(2), [(-1, 2)]),
    "icosahedral, 2D": ((7, 6), ICOSAHEDRAL, [(0, 1), (3, 1), (-1, 2)]),
    "two fields, 3D": ((5, 4, 3), isotropic_two_field(d=3, density=1.4), [(1, -1, 1)]),
    "icosahedral, 3D": ((5, 4, 3), ICOSAHEDRAL, [(1, 0, 0), (1, 1, 1), (2, -1, 1)]),
}


def lattice(comm, cells):
    """An interval, a rectangle of right triangles, or a box of Kuhn's tetrahedra."""
    sides = SIDES[: len(cells)]
    if len(cells) == 1:
        return meshes.interval(comm, 0.0, sides[0], cells[0])
    return (meshes.rectangle, meshes.box)[len(cells) - 2](comm, [0] * len(cells), sides, cells)


@pytest.mark.parametrize("branch", ["slowest", "fastest"])
@pytest.mark.parametrize("case", CASES)
def test_plane_waves_run_around_the_box_and_return(comm, case, branch):
    cells, body, waves = CASES[case]
    dim, n_u, n = len(cells), body.displacement, body.components
    mesh, size = lattice(comm, cells), SIDES[: len(cells)] / cells
    mass = np.prod(size) * np.repeat([body.density, body.inertia], [n_u, n - n_u])
    bare = Problem(cb.Scene(mesh, body, periodic=range(dim)))
    critical = critical_step(bare, "exact")
    bare.close()
    points, _ = whole(mesh)
    for wave in waves:
        q = 2 * np.pi * np.array(wave) / SIDES[:dim]
        squares, modes = scipy.linalg.eigh(lattice_stiffness(body, size, q, False), np.diag(mass))
        number = 0 if branch == "slowest" else -1
        assert squares[0] > 0
        a = modes[:, number] / abs(modes[:, number]).max()
        root = np.sqrt(squares[number])
        steps = max(8, int(np.ceil(np.pi / np.arcsin(0.45 * critical * root))))
        h = 2 * np.sin(np.pi / steps) / root
        omega = 2 * np.pi / steps / h

        def shape(x, t, rows, rate=False, a=a, q=q, h=h, omega=omega):
            factor = -1j * np.sin(omega * h) / h if rate else 1.0
            phase = np.exp(1j * (q @ x[: len(q)] - omega * t + 0.3))
            return np.real(factor * a[rows, None] * phase)

        u, nu = slice(0, n_u), slice(n_u, n)
        start = cb.Initial(*(
            lambda x, rows=rows, rate=rate: shape(x, 0.0, rows, rate)
            for rate in (False, True) for rows in (u, nu)
        ))  # fmt: skip
        scene = cb.Scene(mesh, body, initial=start, periodic=range(dim))
        run = prepared(scene, cb.Synchronous(h, dissipation="symmetric"), until=steps * h)
        for more in (1, steps // 2, steps - 1 - steps // 2):
            run.advance(more)
            found = run.problem.functions(*run.sample())
            field, rate = values(found["u"], found["nu"]), values(found["u_dot"], found["nu_dot"])
            expected = shape(points.T, run.time, slice(0, n)).T
            assert abs(field - expected).max() < 1e-10
            expected = shape(points.T, run.time, slice(0, n), rate=True).T
            assert abs(rate - expected).max() < 1e-10 * omega
        again = shape(points.T, 0.0, slice(0, n)).T
        assert abs(field - again).max() < 1e-10, "it has not come back"
        run.problem.close()


METHODS = {
    "synchronous": cb.Synchronous(), "windows": cb.AVI(), "plain": cb.AVI(balanced=False),
    "exact": cb.AVI(schedule="exact"), "local leapfrog": cb.LocalLeapfrog(),
}  # fmt: skip


@pytest.mark.parametrize("method", METHODS)
def test_shifted_data_give_the_shifted_result(comm, method):
    """By one cell along each axis, to round-off: there is no place that is special."""
    cells, body = (6, 5), scaled_icosahedral_quasicrystal(viscosity=0.4)
    mesh, size = lattice(comm, cells), SIDES[:2] / (6, 5)
    rough = np.random.default_rng(3).normal(size=(4, 3, *cells))

    def data(which, shift):
        def function(x):
            at = np.rint(x[:2] / size[:, None]).astype(int) - np.array(shift)[:, None]
            return rough[which][:, at[0] % cells[0], at[1] % cells[1]]

        return function

    found = []
    for shift in ((0, 0), (1, 0), (0, 1)):
        initial = cb.Initial(*(data(which, shift) for which in range(4)))
        scene = cb.Scene(mesh, body, initial=initial, periodic=(0, 1))
        result = cb.simulate(scene, METHODS[method], until=1.5)
        fields = values(result.u, result.nu, result.u_dot, result.nu_dot)
        points, _ = whole(mesh)
        at = np.rint(points / size).astype(int) - shift
        table = np.full((*cells, fields.shape[1]), np.nan)
        table[at[:, 0] % cells[0], at[:, 1] % cells[1]] = fields
        # Copies of a node have its values.
        assert np.array_equal(table[at[:, 0] % cells[0], at[:, 1] % cells[1]], fields)
        found.append(table)
    for other in found[1:]:
        assert largest(comm, other - found[0]) < 1e-12 * largest(comm, found[0])
