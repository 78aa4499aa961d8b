# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Frequency and decay of seeded plane waves of every form, against ``body.dispersion``.

A sum of all branches Re Σ a_m e^{iq·x} is started on a uniform mesh with free boundaries. A step
carries what happens there one cell further, so that nodes farther inside follow the waves of a body
without end. There the run's fields and rates are projected on e^{iq·x} and split into branches;
each must be multiplied, step by step, by its eigenvalue of the lattice's own step, to round-off.
The frequency measured this way tends to the body's with order 2.
"""

import numpy as np
import pytest
from dense import prepared, state, whole
from scipy.optimize import linear_sum_assignment
from verification.lattice import lattice_masses, lattice_mesh, lattice_step

import complexbody as cb
from complexbody import forms

BUBBLES = {"radius": 0.1, "void_fraction": 0.05, "density": 1.0, "sound_speed": 1.0,
           "pressure": 0.02, "gamma": 1.4}  # fmt: skip
WAVES = {"density": 1.0, "inertia": 0.8, "viscosity": 0.5}
DECAGONAL = {"C11": 2.3, "C12": 0.6, "C13": 0.7, "C33": 2.2, "C44": 0.7,
             "K1": 1.2, "K2": 0.3, "K3": 0.4, "R": 0.2}  # fmt: skip
#: name -> (body, wave vector in cells of the coarse mesh, dimension)
CASES = {
    "icosahedral": (forms.scaled_icosahedral_quasicrystal(), 1.0, 1),
    "icosahedral, diffusive": (
        forms.icosahedral_quasicrystal(1.0, 1.0, 1.46, 0.35, 0.1, 1.0, 0.0, 1.0), 1.0, 1),
    "decagonal": (forms.decagonal_quasicrystal(**DECAGONAL, **WAVES), 1.0, 2),
    "hexagonal": (forms.hexagonal_quasicrystal(1.0, 0.6, 0.4, **WAVES), 1.0, 2),
    "two fields": (forms.isotropic_two_field(d=3, viscosity=0.4), 1.0, 1),
    "Cosserat, Lakes' foam": (forms.cosserat(viscosity=2.0), 1e-4, 1),
    "Cosserat, plane": (forms.plane_cosserat(viscosity=2.0), 1e-4, 2),
    "Cosserat, plane, u of 3": (forms.plane_cosserat(d=3, viscosity=2.0), 1e-4, 1),
    "voids, magnesium": (forms.elastic_voids(viscosity=1e-5), 3e-7, 1),
    "voids, undamped": (forms.elastic_voids(), 3e-7, 1),
    "Mindlin's bar": (forms.mindlin_bar(viscosity=0.05), 1.0, 1),
    "micromorphic": (forms.micromorphic(d=2, viscosity=0.05), 1.0, 1),
    "microcracked": (forms.microcracked(d=2, normal=(1.0, 2.0)), 1.0, 2),
    "nematic, 5CB": (forms.nematic_director(bulk=3e-7), 1e-5, 1),
    "nematic elastomer": (forms.nematic_elastomer(axis=1), 0.05, 1),
    "nematic elastomer, inert": (forms.nematic_elastomer(inertia=0.1), 1.0, 1),
    "bubbly liquid": (
        forms.bubbly_liquid(**BUBBLES, viscosity=3e-3, d=1, linearised=True), 0.5, 1),
}  # fmt: skip
CELLS, STEPS, REACH = {1: 24, 2: 16}, {1: 6, 2: 3}, 2.0  # qL of the body


def amplitudes(run, points, q, heavy):
    """(a, ȧ of ``heavy``) of the waves in the rows that ``points`` tells, which no end has met."""
    inside, x = points
    phase = x[inside] @ q
    basis = np.stack([np.cos(phase), -np.sin(phase)], axis=1)
    fields, rates = (values[inside] for values in state(run))
    out = []
    for values in (fields, rates[:, heavy]):
        parts = np.linalg.lstsq(basis, values, rcond=None)[0]
        out.append(parts[0] + 1j * parts[1])
    return np.concatenate(out)


def measured(comm, body, dim, length, cells, step):
    """Growth per step of each branch in the run and by the lattice; the lattice's frequencies."""
    q = REACH / length * np.array([1.0, 0.6])[:dim]
    sides = length * np.array([1.0, 0.9])[:dim]
    size, n_u, n = sides / cells, body.displacement, body.components
    mesh = lattice_mesh(comm, sides, [cells] * dim)
    if step is None:
        run = prepared(cb.Scene(mesh, body), cb.Synchronous(safety=0.4))
        step = run.step
    map_, heavy = lattice_step(body, size, q, step)
    # in units in which masses are one, or eigenvalues would drown in round-off
    mass, damping = (np.diag(a) for a in lattice_masses(body, size))
    unit = 1 / np.sqrt(np.where(mass > 0, mass, damping))
    unit = np.concatenate([unit, unit[heavy] / step])
    factors, modes = np.linalg.eig(map_ * unit / unit[:, None])
    modes = unit[:, None] * modes
    modes = modes / np.abs(modes[:n] / unit[:n, None]).max(axis=0)
    a, v = modes[:n].sum(axis=1), np.zeros(n, complex)
    v[heavy] = modes[n:].sum(axis=1)

    def wave(values, rows):
        return lambda x: np.real(values[rows, None] * np.exp(1j * (q @ x[:dim])))

    u, nu = slice(0, n_u), slice(n_u, n)
    start = cb.Initial(wave(a, u), wave(a, nu), wave(v, u), wave(v, nu))
    run = prepared(cb.Scene(mesh, body, initial=start), cb.Synchronous(step))
    x = whole(mesh)[0]
    margin = (STEPS[dim] + 2) * size
    points = np.all((x > margin) & (x < sides - margin), axis=1), x
    assert points[0].sum() > 5
    units = abs(modes).max(axis=1)

    def split():
        found = amplitudes(run, points, q, heavy)
        return np.linalg.solve(modes / units[:, None], found / units)

    np.testing.assert_allclose(split(), 1.0, atol=1e-8)
    run.advance(1)
    before, ratios = split(), []
    for _ in range(STEPS[dim]):
        run.advance(1)
        after = split()
        ratios.append(after / before)
        before = after
    return np.array(ratios), factors, step, q


def matched(found, exact):
    """Relative error of each frequency with its own of the exact ones, and the worst of decay."""
    rows, columns = linear_sum_assignment(abs(found[:, None] - exact))
    wrong, decay = found[rows] - exact[columns], abs(exact.imag).max()
    return abs(wrong) / abs(exact[columns]), abs(wrong.imag).max() / (decay if decay > 0 else 1.0)


@pytest.mark.parametrize("name", CASES)
def test_every_branch(comm, name):
    """To round-off the lattice's, by order 2 the body's: frequencies and decay of all branches."""
    body, cell, dim = CASES[name]
    cells, step, errors, decays = CELLS[dim], None, [], []
    light = np.linalg.eigvalsh(body.inertia_matrix)[0] == 0
    damped = np.any(body.viscosity_matrix)
    assert damped != name.endswith("undamped")
    for refine in (1, 2):
        if refine == 2:
            step = step / (4 if light else 2)
        run = measured(comm, body, dim, cell * cells, cells * refine, step)
        ratios, factors, step, q = run
        assert abs(ratios / factors - 1).max() < 1e-9
        omega = 1j * np.log(ratios.mean(axis=0)) / step
        exact = body.dispersion(q)
        assert len(exact) == 2 * body.components - (body.descriptor if light else 0)
        wrong, decay = matched(omega, exact)
        errors.append(wrong.max())
        decays.append(decay)
    assert errors[0] < 0.03
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.2)
    if damped:
        assert decays[0] < 0.03
        assert decays[1] < max(decays[0] / 3, 1e-4)


def test_small_bubbles(comm):
    """The bubbly liquid with its full χ and w, at 1e-6 of R0: Commander and Prosperetti's wave."""
    body = forms.bubbly_liquid(**BUBBLES, d=1)
    errors = []
    for cells in (24, 48):
        q, size, steps = 2.0 / 12, 12.0 / cells, cells // 4
        omega, a = body.dispersion(q, polarisations=True)
        slow = int(np.argmin(np.where(omega.real > 0, omega.real, np.inf)))
        w, a = omega[slow].real, 1e-7 * a[:, slow] / abs(a[1, slow])
        assert w == pytest.approx(float(forms.bubbly_branches(q, **BUBBLES)[0]), rel=1e-10)
        mesh = lattice_mesh(comm, [12.0], [cells])

        def wave(values, row, q=q):
            return lambda x: np.real(values[row] * np.exp(1j * q * x[:1]))

        start = cb.Initial(*(wave(v, i) for v in (a, -1j * w * a) for i in (0, 1)))
        scene = cb.Scene(mesh, body, initial=start)
        run = prepared(scene, cb.Implicit(0.3 * size))
        run.advance(steps)
        at = whole(mesh)[0]
        found = amplitudes(run, (abs(at[:, 0] - 6) < 1.5, at), np.array([q]), [])
        measured = 1j * np.log(found / a) / run.time
        assert abs(measured.imag).max() < 1e-3 * w
        errors.append(abs(measured / w - 1).max())
    assert errors[1] < 1e-3
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.2)
