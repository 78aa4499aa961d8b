# SPDX-License-Identifier: LGPL-3.0-or-later
"""The command line: reads what the user wants, and sees that all ranks end alike.

What the commands do stands in :mod:`complexbody.commands`.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import textwrap
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn

from mpi4py import MPI

from complexbody import __version__, cli_chart, cli_plan, cli_show, cli_stability, commands
from complexbody.cli_texts import EPILOG, RESUME_EPILOG, RUN_EPILOG
from complexbody.errors import CommandError, ComplexBodyError
from complexbody.integrators.asynchronous import SCHEDULES
from complexbody.integrators.petsc_ts import FORMS
from complexbody.masses import SCHEMES
from complexbody.output import CELL_FIELDS, NODE_FIELDS, STEP_FIELDS
from complexbody.together import (
    GRACE,
    Elsewhere,
    Interrupted,
    abort,
    arrive,
    is_copy,
    say,
    signals,
    together,
)


class _Parser(argparse.ArgumentParser):
    """Raises CommandError instead of leaving; help is printed by rank 0 only."""

    def error(self, message: str) -> NoReturn:
        raise CommandError(f"{message}. See {self.prog} --help.")

    def _print_message(self, message: str, file: Any = None) -> None:
        say(MPI.COMM_WORLD, message.rstrip("\n"), stream=file)


def _wide(prog: str) -> argparse.RawDescriptionHelpFormatter:
    return argparse.RawDescriptionHelpFormatter(prog, max_help_position=26, width=100)


def parser() -> argparse.ArgumentParser:
    """The parser of the command line."""
    main = _Parser(
        prog="complexbody",
        description="Dynamics of complex bodies by variational integrators, on FEniCSx.",
        epilog=EPILOG,
        formatter_class=_wide,
        allow_abbrev=False,
    )
    main.add_argument("--version", action="version", version=f"complexbody {__version__}")
    sub = main.add_subparsers(title="commands", metavar="COMMAND", required=True)

    def command(name: str, function: Any, text: str, epilog: str = "") -> argparse.ArgumentParser:
        made = sub.add_parser(
            name, help=text, description=textwrap.fill(text[0].upper() + text[1:] + ".", 100),
            epilog=epilog, formatter_class=_wide, allow_abbrev=False,
        )  # fmt: skip
        made.set_defaults(function=function)
        made.add_argument("--debug", action="store_true", help="show tracebacks of errors")
        return made

    run = command("run", commands.run, "run a scene file", RUN_EPILOG)
    _scene(run)
    _integrator(run)
    run.add_argument(
        "--accuracy", metavar="EPS", type=float,
        help="choose integrator and step, by short runs, for this relative error at the end",
    )  # fmt: skip
    _output(run)
    _checkpoints(run)
    again = command(
        "resume", commands.resume, "go on with a run that was stopped, from its newest checkpoint",
        RESUME_EPILOG,
    )  # fmt: skip
    again.add_argument("folder", metavar="DIR", help="the folder of the run's results")
    again.add_argument("--until", metavar="T", type=float, help="a later end of the run [s]")
    again.add_argument("--no-picture", action="store_true", help="do not draw")
    again.add_argument("--quiet", action="store_true", help="print only warnings and errors")
    check = command(
        "check", commands.check,
        "build everything without running, and say what run would do: is the energy coercive, "
        "which cells limit the step, how many steps, how long",
    )  # fmt: skip
    _scene(check)
    _integrator(check)
    planned = command("plan", cli_plan.command, cli_plan.TEXT)
    _scene(planned)
    _integrator(planned)
    cli_stability.declare(command)
    cli_chart.add(command, _scene)
    cli_show.declare(command)
    command("info", commands.info, "versions, compiler, caches, and which optional parts are there")
    return main


def _scene(to: argparse.ArgumentParser) -> None:
    to.add_argument("file", metavar="FILE", help="a scene file (see complexbody --help)")
    group = to.add_argument_group("scene")
    group.add_argument(
        "--set", metavar="NAME=VALUE", action="append", default=[],
        help="a parameter of the file's scene(), a Python literal or a string; repeatable",
    )  # fmt: skip
    group.add_argument("--until", metavar="T", type=float, help="end of the run [s]")


def _integrator(to: argparse.ArgumentParser) -> None:
    group = to.add_argument_group("integrator")
    names = tuple(commands.INTEGRATORS)
    group.add_argument(
        "--integrator", metavar="NAME", choices=names,
        help=f"{', '.join(names[:-1])} or {names[-1]}; default {names[0]}",
    )  # fmt: skip
    group.add_argument(
        "--step", metavar="H", type=float,
        help="step [s], of local-leapfrog the coarse one; default: safety times the critical step",
    )  # fmt: skip
    group.add_argument(
        "--safety",
        metavar="S",
        type=float,
        help="fraction of the critical step; default 0.9 (synchronous, local-leapfrog), 0.45 (avi)",
    )
    group.add_argument(
        "--dissipation", choices=SCHEMES, help="how viscosity is stepped; default exact"
    )
    group.add_argument(
        "--start", choices=("trapezoidal", "one-sided"),
        help="first kick: half (second order, default) or whole (the paper's, first order)",
    )  # fmt: skip
    group.add_argument(
        "--critical", choices=("cells", "global"),
        help="critical step by a bound of every cell (default) or of the whole body (SLEPc)",
    )  # fmt: skip
    group.add_argument(
        "--schedule", choices=SCHEDULES,
        help="avi: windows, the same by powers of two (default if balanced), or any real steps",
    )  # fmt: skip
    group.add_argument(
        "--corrected", action=argparse.BooleanOptionalAction, default=None,
        help="avi --schedule exact: softer potentials for cells that act alone (default), or the "
        "paper's: --no-corrected --start one-sided --dissipation forward",
    )  # fmt: skip
    group.add_argument(
        "--balanced", action=argparse.BooleanOptionalAction, default=None,
        help="avi: forces act through the steps (default), or in kicks",
    )  # fmt: skip
    group.add_argument(
        "--stabilisation", metavar="NU", type=float,
        help="local-leapfrog: ν of the Chebyshev filter; default 0.15, 0 is none",
    )  # fmt: skip
    group.add_argument(
        "--order", type=int, choices=(1, 2),
        help="implicit: midpoint (2, default), or the paper's scheme or backward Euler (1)",
    )  # fmt: skip
    group.add_argument(
        "--forces", choices=("explicit", "implicit"),
        help="implicit: those on ν explicit (default), or solved for at the step of u alone",
    )  # fmt: skip
    group.add_argument(
        "--quadrature", choices=("vertex", "consistent"),
        help="implicit: a Newton at each node (default), or SNES with χ integrated in full",
    )  # fmt: skip
    group.add_argument(
        "--tolerance",
        metavar="EPS",
        type=float,
        help="implicit, newmark, petsc-ts: of the residual; default 1e-12, 1e-10, 1e-10",
    )
    group.add_argument(
        "--monitor", action="store_true", default=None, help="implicit: print SNES's residuals"
    )
    group.add_argument(
        "--petsc", metavar="NAME=VALUE", action="append", default=[],
        help="implicit, newmark, petsc-ts: a PETSc option, such as ksp_type=gmres; repeatable",
    )  # fmt: skip
    group.add_argument(
        "--force", choices=("assembly", "matrix"),
        help="assembled-leapfrog: assembled at each step (default), or a product",
    )  # fmt: skip
    group.add_argument(
        "--kind", choices=tuple(FORMS),
        help="petsc-ts: generalised-α (default), Runge–Kutta, trapezoidal or midpoint rule",
    )  # fmt: skip
    group.add_argument(
        "--levels", metavar="L", type=int,
        help="local-leapfrog: octaves of smaller steps; default: as many as cost the least",
    )  # fmt: skip
    group.add_argument(
        "--unstable-ok", action="store_true", default=None,
        help="allow a step above the critical one, and energy that grows",
    )  # fmt: skip


def _output(to: argparse.ArgumentParser) -> None:
    group = to.add_argument_group("output")
    group.add_argument(
        "--out", metavar="DIR", help="folder of the results; default results/NAME of the file"
    )
    group.add_argument(
        "--every", metavar="DT", type=float,
        help="time between fields [s]; default: at the start and the end",
    )  # fmt: skip
    group.add_argument(
        "--fields", metavar="NAMES",
        help=f"of {', '.join((*NODE_FIELDS, *CELL_FIELDS, *STEP_FIELDS))}, separated by commas, "
        f"or none; default {','.join(NODE_FIELDS)}",
    )  # fmt: skip
    group.add_argument(
        "--probe", metavar="NAME=X,Y,Z", action="append", default=[],
        help="a point whose fields go to a table; repeatable",
    )  # fmt: skip
    group.add_argument(
        "--probe-steps", metavar="N", type=int, help="steps between its rows; default 10"
    )
    group.add_argument(
        "--ledger-steps",
        metavar="N",
        type=int,
        help="steps between ledger rows; default: a few per cent of the run, at least 100 rows",
    )
    group.add_argument(
        "--speed-up", action="store_true",
        help="local steps: time some synchronous steps in the end, and tell what was saved",
    )  # fmt: skip
    group.add_argument(
        "--no-plan", action="store_true", help="compute also what changes no result (see plan)"
    )
    group.add_argument("--no-picture", action="store_true", help="do not draw")
    group.add_argument("--quiet", action="store_true", help="print only warnings and errors")


def _checkpoints(to: argparse.ArgumentParser) -> None:
    group = to.add_argument_group("checkpoints (DIR/checkpoints; complexbody resume DIR goes on)")
    group.add_argument(
        "--checkpoint-every", metavar="S", type=float,
        help="wall time between two [s]; default 600, 0 for none at all",
    )  # fmt: skip
    group.add_argument(
        "--checkpoint-steps", metavar="N", type=int, help="steps between two, beside that time"
    )
    group.add_argument(
        "--checkpoint-keep", metavar="N", type=int, help="how many are kept; default 2"
    )


@contextmanager
def _warnings(comm: Any) -> Iterator[None]:
    """Show warnings as one line each, on rank 0."""
    before = warnings.showwarning

    def show(message: Any, category: Any, *where: Any, **more: Any) -> None:
        say(comm, f"complexbody: warning: {message}", stream=sys.stderr)

    warnings.showwarning = show
    try:
        yield
    finally:
        warnings.showwarning = before


def _as_options(message: str) -> str:
    """A message to someone who calls functions, for someone who gives options."""
    for argument in ("unstable_ok=True", "growth=None"):
        message = message.replace(argument, "--unstable-ok")
    return message


def _parsed(words: list[str]) -> argparse.Namespace | None:
    """The arguments; None where all that was asked for was --help or --version."""
    try:
        arguments = parser().parse_args(words)
    except SystemExit:
        return None
    arguments.words, arguments.parse = words, parser().parse_args
    return arguments


def _obeyed(arguments: argparse.Namespace, ranks: Any) -> None:
    """Do what the arguments say; collective.

    Raises:
        CommandError: where a function of the scene file wants the process to end.
    """
    try:
        arguments.function(arguments, ranks)
    except (Exception, KeyboardInterrupt, Interrupted):
        raise
    except BaseException as end:  # sys.exit(), say, which would pass for success
        raise CommandError(
            f"A function of the scene file raised {type(end).__name__}({end}). Let it return, or "
            "raise an Exception."
        ) from end


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; collective.

    Args:
        argv: Arguments; those of the process by default.

    Returns:
        The exit code, the same on all ranks.
    """
    words = list(sys.argv[1:] if argv is None else argv) or ["--help"]
    # PETSc's handler makes a crash of a reader that has left ("complexbody … | head").
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)
    # It asks a run for a checkpoint; before and after it there is none to make.
    signal.signal(signal.SIGUSR1, signal.SIG_IGN)
    comm = MPI.COMM_WORLD
    # Apart from messages of scenes and simulations, which an error may cut off.
    ranks, last = comm.Dup(), comm.Dup()
    code, debug = 0, "--debug" in words
    try:
        with signals(ranks), _warnings(comm), together(ranks):
            arguments = _parsed(words)
            if arguments is not None:
                _obeyed(arguments, ranks)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except Elsewhere:  # shown by the rank that met it
        code = 1
    except ComplexBodyError as error:
        if debug and not is_copy(error):
            traceback.print_exception(error)
        say(comm, f"complexbody: error: {_as_options(str(error))}", stream=sys.stderr)
        code = error.exit_code
    except KeyboardInterrupt:  # raised by a user's function: Ctrl-C is Interrupted
        say(comm, "complexbody: stopped by a KeyboardInterrupt", stream=sys.stderr)
        code = 128 + signal.SIGINT
    except Interrupted as stop:
        say(comm, f"complexbody: {stop}", stream=sys.stderr)
        code = stop.exit_code
    except Exception as error:
        traceback.print_exception(error)
        where = f" on rank {comm.rank}" if comm.size > 1 else ""
        told = f"complexbody: bug{where}: {type(error).__name__}: {error}. Please report it."
        print(told, file=sys.stderr, flush=True)
        code = 1
    # Together: with a failure, mpirun stops all as soon as one has left.
    if not arrive(last, GRACE if code else None):
        abort(last, code, f"rank {comm.rank} has ended ({code}), others have not: all are stopped.")
    ranks.Free()
    last.Free()
    return code
