# SPDX-License-Identifier: LGPL-3.0-or-later
"""The typed errors of complexbody.

Each message says in one sentence what is wrong and in one what to do. Whatever depends on data that
differ between ranks goes through :func:`agree`, so that every rank raises or none does.
"""

from __future__ import annotations

from typing import Any


class ComplexBodyError(Exception):
    """Base of every error a user of complexbody can cause or meet."""

    exit_code = 2


class BodyError(ComplexBodyError, ValueError):
    """A body is ill posed: shapes, density, inertia, viscosity or energy."""


class CoercivityError(BodyError):
    """The Hessian of the energy density is not symmetric, not finite or not coercive (A1)."""


class PrestressError(BodyError):
    """A state to linearise about is not natural: P̄, z̄ or S̄ is not zero there.

    Attributes:
        prestress: The :class:`complexbody.linearise.Prestress` there.
    """

    def __init__(self, message: str, prestress: Any = None) -> None:
        super().__init__(message)
        self.prestress = prestress


class SceneError(ComplexBodyError, ValueError):
    """A scene does not fit together: supports, loads, tags, initial data."""


class MeshError(ComplexBodyError, ValueError):
    """A mesh has inverted, flat or non-finite cells, or cells complexbody does not know."""


class IntegratorError(ComplexBodyError, ValueError):
    """An integrator cannot take this body, or was given options that exclude each other."""


class StepError(IntegratorError):
    """A time step is not positive, or is larger than the critical one."""


class OutputError(ComplexBodyError, OSError):
    """Results cannot be written where the user asked."""


class CheckpointError(ComplexBodyError):
    """A run cannot be resumed: no checkpoint is whole, or of this scene; or none can be made."""

    exit_code = 6


class ResultsError(ComplexBodyError, ValueError):
    """A folder does not have the results that are asked for, or they cannot be read."""


class CommandError(ComplexBodyError):
    """The command line or a scene file is wrong."""


class ChartError(ComplexBodyError, ValueError):
    """A chart cannot be made of this scene, or its file is of another chart."""


class AccuracyError(ComplexBodyError, ValueError):
    """An accuracy is asked for that the mesh cannot give, or that makes no sense."""


class MissingPackage(ComplexBodyError, ImportError):
    """An optional package or a compiler is not there; the message has the install line."""

    exit_code = 3


class DivergenceError(ComplexBodyError, ArithmeticError):
    """A run produced non-finite values, energy it was not given, or cells turned inside out.

    Attributes:
        ledger: The books up to the row that stopped it, where a ledger was kept.
        last_good: Time of the last row in which all was well [s], None if there was none.
        place: The node or cell, a :class:`complexbody.guards.Place`, or None if all are alike.
    """

    exit_code = 4
    ledger: Any = None
    last_good: float | None = None
    place: Any = None


class SolverError(ComplexBodyError, ArithmeticError):
    """An implicit step has no (unique) solution, or a solver did not find it.

    Attributes:
        result: The Result at the last good time, where a simulation was under way.
    """

    exit_code = 4
    result: Any = None


def agree(comm: Any, error: Exception | None) -> None:
    """Raise on all ranks of ``comm`` if any rank holds an error; collective.

    Args:
        comm: An mpi4py communicator.
        error: What this rank found, or None.

    Raises:
        Exception: the error of the lowest rank that has one, with its own type, on every rank.
    """
    found = comm.allgather(None if error is None else (type(error), str(error)))
    for rank, entry in enumerate(found):
        if entry is not None:
            kind, text = entry
            where = "" if comm.size == 1 or f"rank {rank}" in text else f" (rank {rank})"
            raise kind(text + where)
