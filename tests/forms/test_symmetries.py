# SPDX-License-Identifier: LGPL-3.0-or-later
"""Every family under small rotations and in mirrors: how ν turns, and the parity it states.

Energies as numbers, by UFL and without a compiler; then one plane of symmetry of a scene each.
"""

from __future__ import annotations

import dolfinx
import numpy as np
import pytest
import ufl
from harness import refused
from mpi4py import MPI

import complexbody as cb
from complexbody import forms, rotations
from complexbody.errors import SceneError
from complexbody.mirrors import representation
from complexbody.problem import Problem
from complexbody.rotations import axial

pytestmark = pytest.mark.serial

RUBBER = [forms.nematic_elastomer(axis=axis) for axis in range(3)]
#: Bodies and the axes perpendicular to which they have mirrors.
BODIES = {
    "Cosserat": (forms.cosserat(), "xyz"),
    "Cosserat, plane": (forms.plane_cosserat(), "xyz"),
    "Cosserat, plane, u3": (forms.plane_cosserat(d=3), "xyz"),
    "micromorphic": (forms.micromorphic(), "xyz"),
    "micromorphic, plane": (forms.micromorphic(d=2), "xyz"),
    "bar": (forms.mindlin_bar(), "xyz"),
    "cracks": (forms.microcracked(k3=0.2, k3_sym=0.2), "yz"),
    "cracks, plane": (forms.microcracked(d=2, normal=(0, 2), k3=0.2), "xz"),
    "voids": (forms.elastic_voids(), "xyz"),
    "two fields": (forms.isotropic_two_field(), "xyz"),
    "two fields, plane": (forms.isotropic_two_field(d=2), "xyz"),
    "icosahedral": (forms.scaled_icosahedral_quasicrystal(), "xyz"),
    "decagonal": (forms.decagonal_quasicrystal(), "xyz"),
    "hexagonal": (forms.hexagonal_quasicrystal(), "xyz"),
    "nematic": (forms.nematic_director(), "xyz"),
    **{f"elastomer, {axis}": (RUBBER[axis], "xyz") for axis in range(3)},
    "bubbles": (forms.bubbly_liquid(linearised=True), "xyz"),
    "bubbles, exact": (forms.bubbly_liquid(d=2), "xyz"),
}
#: Which way the one component of u points decides about the mirror: antiplane here.
ANTIPLANE = {"hexagonal"}


def deformation(d):
    """Of a micro-medium: χ → Qχ, of which ν = χ − I is the small part; it does not turn as QνQᵀ."""
    action = rotations.linear(
        "micro-deformation", lambda Q: np.kron(Q[:d, :d], np.eye(d)), d * d, planar=d == 2
    )
    return action.about(np.eye(d).ravel())


def director(axis):
    """Two components of a director n + ν with n along an axis: q × n is added to them."""
    across = [i for i in range(3) if i != axis]
    arm = np.cross(np.eye(3), np.eye(3)[axis])[:, across].T  # q × n, of components across n

    def act(Q, nu):
        return nu + arm @ axial(Q) / 2

    return rotations.RotationAction("director", act, 2, infinitesimal=True)


ROTATIONS = {
    "Cosserat": rotations.microrotation().about(),
    "Cosserat, plane": rotations.angle().about(),
    "Cosserat, plane, u3": rotations.angle().about(),
    "micromorphic": deformation(3),
    "micromorphic, plane": deformation(2),
    # At rest at zero, a vector or a scalar does not feel small rotations; phasons do not either.
    "cracks": rotations.vector().about(),
    "cracks, plane": rotations.vector(2).about(),
    "voids": rotations.scalar().about(),
    "two fields": rotations.vector().about(),
    "two fields, plane": rotations.vector(2).about(),
    "icosahedral": rotations.scalar(3).about(),
    "decagonal": rotations.perpendicular().about(),
    **{f"elastomer, {axis}": director(axis) for axis in range(3)},
    "bubbles": rotations.scalar().about(),
    "bubbles, exact": rotations.scalar().about(),
}


@pytest.mark.parametrize("name", ROTATIONS)
def test_small_rotations_cost_nothing(name):
    """Runs of these bodies book no angular momentum by themselves: see complexbody.forms."""
    body = BODIES[name][0]
    assert body.rotation is None
    found = cb.objectivity(body, ROTATIONS[name], states=2)
    assert found, str(found)
    generator = ROTATIONS[name].generator(np.zeros((1, body.descriptor)))
    if np.abs(generator).max() > 0:
        assert not cb.objectivity(body, rotations.scalar(body.descriptor).about(), states=2)


def test_a_micro_deformation_is_no_tensor():
    assert not cb.objectivity(BODIES["micromorphic"][0], rotations.tensor().about(), states=2)


def changes(body, name, mirror, sign=1.0):
    """Change of e in a mirror, relative to its size, at a random state; ν's parity times a sign."""
    n_u, k = body.displacement, body.descriptor
    rng = np.random.default_rng(1)
    U, nu, N = (rng.normal(size=shape) for shape in ((n_u, 3), (k,), (k, 3)))
    if n_u == 1:  # a bar has one dimension, an antiplane body two
        U[0, 2 if name in ANTIPLANE else slice(1, 3)] = 0.0
        N[0, 2 if name in ANTIPLANE else slice(1, 3)] = 0.0
    S = representation("even" if name in ANTIPLANE else "polar", mirror, n_u, "u")
    R = sign * representation(body.parity, mirror, k, "ν")
    return value(body, S @ U @ mirror, R @ nu, R @ N @ mirror) / value(body, U, nu, N) - 1


def value(body, U, nu, N):
    parts = (ufl.as_tensor(np.asarray(a).tolist()) for a in (U, nu, N))
    return float(body.energy(*parts))


@pytest.mark.parametrize("name", BODIES)
def test_mirrors(name):
    """By the parity the energy is the same; by the opposite one it is not, if it couples u and ν.

    In the mirror across their normal cracks do not look the same by either.
    """
    body, axes = BODIES[name]
    for axis in range(body.displacement if body.displacement > 1 else 3):
        mirror = np.diag(np.where(np.arange(3) == axis, -1.0, 1.0))
        same = abs(changes(body, name, mirror)) < 1e-12
        assert same == ("xyz"[axis] in axes), (axis, changes(body, name, mirror))
        if name != "nematic":  # whose u is coupled with nothing
            assert abs(changes(body, name, mirror, -1.0)) > 1e-6


@pytest.mark.parametrize(
    "name, dim, axis, held",
    [
        # Components of (u, ν) that vanish on the plane.
        ("Cosserat, plane", 2, 0, [0, 2]),
        ("micromorphic, plane", 2, 0, [0, 3, 4]),
        ("elastomer, 0", 3, 0, [0, 3, 4]),
        ("elastomer, 0", 3, 1, [1, 3]),
    ],
)
def test_planes_of_symmetry_know_the_parity(name, dim, axis, held):
    made = (dolfinx.mesh.create_unit_square, dolfinx.mesh.create_unit_cube)[dim - 2]
    mesh, body = made(MPI.COMM_SELF, *dim * [1]), BODIES[name][0]
    plane = cb.Symmetry(where=lambda x: x[axis] < 1e-9)
    fixed = Problem(cb.Scene(mesh, body, supports=[plane])).supports.fixed
    for row, x in zip(fixed, mesh.geometry.x, strict=True):
        assert list(np.flatnonzero(row)) == (held if x[axis] < 1e-9 else [])


def test_the_plane_across_cracks_is_refused():
    mesh = dolfinx.mesh.create_unit_square(MPI.COMM_SELF, 1, 1)
    body = forms.microcracked(d=2, k3=0.2)
    with refused(SceneError, "energy of microcracked body", "mirror perpendicular to x"):
        Problem(cb.Scene(mesh, body, supports=[cb.Symmetry(where=lambda x: x[0] < 1e-9)]))
    Problem(cb.Scene(mesh, body, supports=[cb.Symmetry(where=lambda x: x[1] < 1e-9)]))
