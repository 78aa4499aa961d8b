# SPDX-License-Identifier: LGPL-3.0-or-later
"""Scene files: Python files that say what to simulate, and what the command line may change.

A scene file has ``def scene(comm, **parameters) -> cb.Scene`` and, if it likes, ``DEFAULTS`` (a
dict of :data:`SETTINGS`), ``check(result) -> str``, which raises AssertionError if the physics is
wrong, and ``picture(result, path)``; for charts, ``exact(t, **parameters)``, a dict with some of u,
nu, u_dot, nu_dot at t, functions of x (3, npts). All are called on all ranks.
"""

from __future__ import annotations

import ast
import inspect
import linecache
import sys
import traceback
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from complexbody import _compat
from complexbody.errors import CommandError, ComplexBodyError
from complexbody.scene import Scene
from complexbody.together import Interrupted

#: What ``DEFAULTS`` may have; the options of ``complexbody run`` go before it.
SETTINGS = (
    "until", "every", "times", "fields", "probes", "probe_steps", "ledger_steps", "out",
    "integrator", "step", "safety", "dissipation", "start", "critical", "unstable_ok",
    "balanced", "stabilisation", "levels",
)  # fmt: skip


class CheckFailed(CommandError):
    """The scene file's check found that the physics is wrong."""

    exit_code = 5


class SceneFile:
    """A scene file that has been read.

    Args:
        path: The file.

    Attributes:
        path: The file; ``defaults``: its DEFAULTS.

    Raises:
        CommandError: naming file, line and exception if it cannot be imported, and naming what is
            missing if it has no scene().
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.module = self._imported()
        self._function = getattr(self.module, "scene", None)
        if not callable(self._function):
            raise CommandError(
                f"{self.path} has no function scene. Define: def scene(comm, **parameters) "
                "returning a complexbody.Scene."
            )
        self._signature = inspect.signature(self._function)
        if not self._signature.parameters:
            raise CommandError(f"{self.path}: scene() takes no comm. Define: def scene(comm, …).")
        self.defaults = self._checked_defaults()

    @property
    def title(self) -> str:
        """First line of the file's docstring, or its name."""
        return ((self.module.__doc__ or "").strip().splitlines() or [self.path.stem])[0]

    @property
    def draws_with_vtk(self) -> bool:
        """Whether the file names VTK, which without a GL library does not raise but crashes."""
        return any(name in self._source for name in (b"pyvista", b"vtk"))

    def _imported(self) -> types.ModuleType:
        try:
            source = self.path.read_bytes()
        except OSError as error:
            raise CommandError(
                f"{self.path} cannot be read ({error.strerror}). Give a scene file: a Python file "
                "with a function scene(comm, …)."
            ) from error
        self._source = source
        # Not through importlib: no __pycache__ beside it, for which ranks would race.
        module = types.ModuleType(f"complexbody_scene_{self.path.stem}")
        module.__file__ = str(self.path)
        sys.modules[module.__name__] = module
        # Files beside it can be imported, but do not hide anything that is installed.
        folder = str(self.path.resolve().parent)
        if folder not in sys.path:
            sys.path.append(folder)
        linecache.checkcache(str(self.path))
        with self._blamed(""):
            exec(compile(source, str(self.path), "exec"), module.__dict__)
        return module

    def _checked_defaults(self) -> dict[str, Any]:
        defaults = getattr(self.module, "DEFAULTS", {})
        if not isinstance(defaults, Mapping):
            raise CommandError(f"{self.path}: DEFAULTS is not a dict. Give dict(until=…, …).")
        unknown = [str(name) for name in defaults if name not in SETTINGS]
        if unknown:
            raise CommandError(
                f"{self.path}: DEFAULTS has unknown {', '.join(unknown)}. Known: "
                f"{', '.join(SETTINGS)}."
            )
        return dict(defaults)

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters of scene() but the communicator, with their defaults (or inspect's empty)."""
        named = list(self._signature.parameters.values())[1:]
        kinds = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
        return {p.name: p.default for p in named if p.kind not in kinds}

    def complete(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """All parameters: those given, checked against the signature, and the defaults.

        Raises:
            CommandError: for unknown or missing names, and for a value of another kind than the
                default's.
        """
        known = self.parameters
        listed = ", ".join(
            name if default is inspect.Parameter.empty else f"{name}={default!r}"
            for name, default in known.items()
        )
        listed = f"Its parameters: {listed}." if listed else "It has no parameters."
        kinds = {p.kind for p in self._signature.parameters.values()}
        for name in given:
            if name not in known and inspect.Parameter.VAR_KEYWORD not in kinds:
                raise CommandError(f"{self.path}: scene() has no parameter {name}. {listed}")
        values = {**known, **given}
        for name, value in values.items():
            if value is inspect.Parameter.empty:
                raise CommandError(
                    f"{self.path}: scene() needs {name}. Give --set {name}=…. {listed}"
                )
            values[name] = self._like(name, value, known.get(name))
        return values

    def _like(self, name: str, value: Any, default: Any) -> Any:
        """``value``, refused where the default's type shows that it cannot be meant."""
        wanted = ""
        if isinstance(default, bool):
            wanted = "" if isinstance(value, bool) else "True or False"
        elif isinstance(default, int | float):
            number = isinstance(value, int | float) and not isinstance(value, bool)
            wanted = "" if number else "a number"
            if number and isinstance(default, int) and float(value).is_integer():
                return int(value)  # 1e3 cells are 1000 cells
        if wanted:
            raise CommandError(
                f"{self.path}: parameter {name} is {value!r}. Give {wanted} (its default is "
                f"{default!r})."
            )
        return value

    def scene(self, comm: Any, parameters: Mapping[str, Any]) -> Scene:
        """The scene that the file makes; collective.

        Raises:
            CommandError: naming file, line and exception, or what it returned instead of a Scene.
        """
        _compat.steady_partitions()  # a run that is resumed has the same parts
        with self._blamed("scene()"):
            made = self._function(comm, **parameters)  # type: ignore[misc]
        if not isinstance(made, Scene):
            raise CommandError(
                f"{self.path}: scene() returned {_a(made)}, not a complexbody.Scene. "
                "Let it return one."
            )
        if made.mesh.comm.size != comm.size:
            raise CommandError(
                f"{self.path}: scene() made its mesh on {made.mesh.comm.size} of {comm.size} "
                "ranks. Make it with the comm it is given."
            )
        # A scene that has no name of its own has the file's.
        return made if made.name != Scene.name else replace(made, name=self.path.stem)

    @property
    def source(self) -> bytes:
        """The file's content."""
        return self._source

    def exact(self, t: float, **parameters: Any) -> Any:
        """What the file's ``exact(t, …)`` says, given those of the parameters that it takes.

        Raises:
            CommandError: naming file, line and exception.
        """
        with self._blamed("exact()"):
            return self.module.exact(t, **accepted(self.module.exact, parameters))

    def has(self, name: str) -> bool:
        """Whether the file has a function ``name``."""
        return callable(getattr(self.module, name, None))

    def check(self, result: Any) -> str:
        """What the file's check says, "passed" if nothing; collective.

        Raises:
            CheckFailed: if it raises AssertionError.
            CommandError: naming file, line and exception for any other.
        """
        with self._blamed("check()"):
            try:
                said = self.module.check(result)
            except AssertionError as failure:
                line, source = self._line(failure)
                why = str(failure) or f"assertion failed: {source}"
                raise CheckFailed(f"Check failed ({self.path}, line {line}): {why}") from failure
        return "passed" if said is None else str(said)

    def picture(self, result: Any, path: Path) -> None:
        """Let the file draw the result; collective.

        Raises:
            CommandError: naming file, line and exception.
        """
        with self._blamed("picture()"):
            self.module.picture(result, path)

    def _line(self, error: BaseException) -> tuple[int | None, str]:
        """The last line of this file that the exception passed, and its text."""
        if isinstance(error, SyntaxError) and error.filename == str(self.path):
            return error.lineno, (error.text or "").strip()
        for frame in reversed(traceback.extract_tb(error.__traceback__)):
            if frame.filename == str(self.path):
                return frame.lineno, (frame.line or "").strip()
        return None, ""

    @contextmanager
    def _blamed(self, doing: str) -> Iterator[None]:
        """Name file and line in whatever is raised inside; complexbody's errors keep their kind."""
        try:
            yield
        except CheckFailed:
            raise
        except (KeyboardInterrupt, Interrupted):
            raise
        except BaseException as error:  # sys.exit() and what a file derives from BaseException
            line, _ = self._line(error)
            place = f"{self.path}, line {line}" if line else str(self.path)
            place += f", in {doing}" if doing else ""
            if isinstance(error, ComplexBodyError):
                raise type(error)(f"{error} ({place})") from error
            what = error.msg if isinstance(error, SyntaxError) else _text(error).split("\n")[0]
            raise CommandError(
                f"{place}: {type(error).__name__}: {what}. Correct the scene file; --debug shows "
                "the whole traceback."
            ) from error


def _text(error: BaseException) -> str:
    try:
        return str(error)
    except Exception:  # of an exception of the file's own
        return "its text cannot be had"


def _a(thing: Any) -> str:
    return "None" if thing is None else f"a {type(thing).__name__}"


def accepted(function: Callable[..., Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Those of the values that a function has parameters for, by name."""
    known = inspect.signature(function).parameters
    if any(p.kind is inspect.Parameter.VAR_KEYWORD for p in known.values()):
        return dict(values)
    return {name: value for name, value in values.items() if name in known}


def assignments(texts: Sequence[str]) -> dict[str, Any]:
    """Parse ``name=value`` texts; values are Python literals, else strings.

    Raises:
        CommandError: for a text without a name or "=".
    """
    out: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name.strip().isidentifier():
            raise CommandError(f"--set {text}: not name=value. Give, for instance, --set cells=40.")
        try:
            out[name.strip()] = ast.literal_eval(value.strip())
        except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
            out[name.strip()] = value
    return out


def points(texts: Sequence[str]) -> dict[str, tuple[float, ...]]:
    """Parse ``name=x,y,z`` texts.

    Raises:
        CommandError: for a text without a name or with coordinates that are not numbers.
    """
    out: dict[str, tuple[float, ...]] = {}
    for text in texts:
        name, _, where = text.partition("=")
        try:
            out[name.strip()] = tuple(float(x) for x in where.split(","))
        except ValueError:
            name = ""
        if not name.strip():
            raise CommandError(f"--probe {text}: not name=x,y,z. Give --probe tip=1,0.5,0.")
    return out
