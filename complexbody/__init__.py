# SPDX-License-Identifier: LGPL-3.0-or-later
"""complexbody: dynamics of complex bodies by variational integrators on FEniCSx.

Materials whose points carry, besides the displacement u, a descriptor ν of their inner structure.
Energies are written in UFL; forces, masses, dissipation and stable steps follow from them.
After M. Focardi and P. M. Mariano, *Discrete dynamics of complex bodies with substructural
dissipation: variational integrators and convergence* ("the paper" in docstrings).
"""

from complexbody.body import Body
from complexbody.checkpoint import Checkpoint
from complexbody.errors import ComplexBodyError
from complexbody.histories import constant, ramp, ricker, sine, step, table
from complexbody.integrators.asynchronous import AVI
from complexbody.integrators.implicit import Implicit
from complexbody.integrators.local_leapfrog import LocalLeapfrog
from complexbody.integrators.peers import AssembledLeapfrog, Newmark, PetscTS
from complexbody.integrators.synchronous import Synchronous
from complexbody.output import Output
from complexbody.planning import Plan, plan
from complexbody.precheck import realised_speed_up
from complexbody.result import Result
from complexbody.scene import BodyForce, Fix, Initial, Pressure, Scene, Traction
from complexbody.show import Look, show
from complexbody.simulate import simulate
from complexbody.stability import stability
from complexbody.workprecision import Chart, chart

__version__ = "0.1.0"

__all__ = [
    "AVI",
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
    "Output",
    "PetscTS",
    "Plan",
    "Pressure",
    "Result",
    "Scene",
    "Synchronous",
    "Traction",
    "chart",
    "constant",
    "plan",
    "ramp",
    "realised_speed_up",
    "ricker",
    "show",
    "simulate",
    "sine",
    "stability",
    "step",
    "table",
]
