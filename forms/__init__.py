# SPDX-License-Identifier: LGPL-3.0-or-later
"""Families of complex bodies, one file each: formula, constants with units and sources, limits.

Each function returns a :class:`complexbody.body.Body` or raises a
:class:`~complexbody.errors.BodyError` that names the inequality its constants break. Of each,
``body.dispersion(q)`` has the plane waves, ``body.scales(cell, size)`` the times of the fields.

Bodies say what a mirror does to ν (``body.parity``), for planes of symmetry. They do not say how
rotations turn it (``body.rotation``), though their energies, quadratic in ∇u, are invariant under
small ones: every run would book an angular momentum, which supports and the viscosity ην̇ of
rotations, directors and micro-deformations do not keep. Who wants it gives the action:
``dataclasses.replace(body, rotation=cb.rotations.microrotation().about())``.
"""

from complexbody.forms.bubbly import (
    bubbly_branches,
    bubbly_dispersion,
    bubbly_liquid,
    minnaert,
)
from complexbody.forms.cosserat import cosserat, cosserat_constants, plane_cosserat
from complexbody.forms.decagonal import decagonal_quasicrystal
from complexbody.forms.hexagonal import hexagonal_quasicrystal
from complexbody.forms.icosahedral import (
    icosahedral_quasicrystal,
    phason_moduli,
    scaled_icosahedral_quasicrystal,
)
from complexbody.forms.microcracked import microcracked
from complexbody.forms.micromorphic import micromorphic, mindlin_bar
from complexbody.forms.nematic import nematic_director, nematic_elastomer
from complexbody.forms.two_field import isotropic_two_field
from complexbody.forms.voids import elastic_voids

__all__ = [
    "bubbly_branches",
    "bubbly_dispersion",
    "bubbly_liquid",
    "cosserat",
    "cosserat_constants",
    "decagonal_quasicrystal",
    "elastic_voids",
    "hexagonal_quasicrystal",
    "icosahedral_quasicrystal",
    "isotropic_two_field",
    "microcracked",
    "micromorphic",
    "mindlin_bar",
    "minnaert",
    "nematic_director",
    "nematic_elastomer",
    "phason_moduli",
    "plane_cosserat",
    "scaled_icosahedral_quasicrystal",
]
