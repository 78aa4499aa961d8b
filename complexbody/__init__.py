# SPDX-License-Identifier: LGPL-3.0-or-later
"""complexbody: dynamics of complex bodies by variational integrators on FEniCSx.

Materials whose points carry, besides the displacement u, a descriptor ν of their inner structure.
Energies are written in UFL; forces, masses, dissipation and stable steps follow from them.
After M. Focardi and P. M. Mariano, *Discrete dynamics of complex bodies with substructural
dissipation: variational integrators and convergence* ("the paper" in docstrings).
"""

from complexbody import rotations
from complexbody.body import Body
from complexbody.checkpoint import Checkpoint
from complexbody.densities import deformation
from complexbody.derived import derived_fields
from complexbody.dispersion_picture import plot_dispersion
from complexbody.errors import ComplexBodyError
from complexbody.histories import constant, ramp, ricker, sine, step, table
from complexbody.integrators.asynchronous import AVI
from complexbody.integrators.implicit import Implicit
from complexbody.integrators.local_leapfrog import LocalLeapfrog
from complexbody.integrators.peers import AssembledLeapfrog, Newmark, PetscTS
from complexbody.integrators.synchronous import Synchronous
from complexbody.linearise import Prestress, linearise, prestress
from complexbody.momentum import angular_momentum
from complexbody.objectivity import Objectivity, objectivity
from complexbody.output import Output
from complexbody.periodicity import Periodic
from complexbody.planning import Plan, plan
from complexbody.precheck import realised_speed_up
from complexbody.result import Result
from complexbody.scene import (
    Absorb,
    BodyForce,
    Fix,
    Initial,
    PointSource,
    Pressure,
    Scene,
    Symmetry,
    Traction,
)
from complexbody.show import Look, show
from complexbody.simulate import simulate
from complexbody.stability import stability
from complexbody.workprecision import Chart, chart

__version__ = "0.1.0"

__all__ = [
    "AVI",
    "Absorb",
    "AssembledLeapfrog",
    "Body",
    "BodyForce",
    "Chart",
    "Checkpoint",
    "ComplexBodyError",
    "Fix",
    "Implicit",
    "Initial",
    "LocalLeapfrog",
    "Look",
    "Newmark",
    "Objectivity",
    "Output",
    "Periodic",
    "PetscTS",
    "Plan",
    "PointSource",
    "Pressure",
    "Prestress",
    "Result",
    "Scene",
    "Symmetry",
    "Synchronous",
    "Traction",
    "angular_momentum",
    "chart",
    "constant",
    "deformation",
    "derived_fields",
    "linearise",
    "objectivity",
    "plan",
    "plot_dispersion",
    "prestress",
    "ramp",
    "realised_speed_up",
    "ricker",
    "rotations",
    "show",
    "simulate",
    "sine",
    "stability",
    "step",
    "table",
]
