# SPDX-License-Identifier: LGPL-3.0-or-later
"""Families of complex bodies, one file each: formula, constants with units and sources, limits.

Each function returns a :class:`complexbody.body.Body` or raises a
:class:`~complexbody.errors.BodyError` that names the inequality its constants break.
"""

from complexbody.forms.bubbly import (
    bubbly_branches,
    bubbly_dispersion,
    bubbly_liquid,
    minnaert,
)
from complexbody.forms.decagonal import decagonal_quasicrystal
from complexbody.forms.hexagonal import hexagonal_quasicrystal
from complexbody.forms.icosahedral import (
    icosahedral_quasicrystal,
    phason_moduli,
    scaled_icosahedral_quasicrystal,
)
from complexbody.forms.two_field import isotropic_two_field
from complexbody.forms.voids import elastic_voids

__all__ = [
    "bubbly_branches",
    "bubbly_dispersion",
    "bubbly_liquid",
    "decagonal_quasicrystal",
    "elastic_voids",
    "hexagonal_quasicrystal",
    "icosahedral_quasicrystal",
    "isotropic_two_field",
    "minnaert",
    "phason_moduli",
    "scaled_icosahedral_quasicrystal",
]
