"""What fuzzing shares: junk, a time limit, and the verdict on one bad input.

A bad input must end in one of complexbody's typed errors, the same on all ranks, soon, and with
advice; or, where it turns out to be none, in finite numbers.
"""

import contextlib
import fractions
import io
import json
import os
import re
import shutil
import signal
import time
import warnings

import numpy as np
from harness import _VERBS
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from mpi4py import MPI

from complexbody.cli import main
from complexbody.errors import ComplexBodyError

#: Seconds that one case may take, compiling included.
LIMIT = 60.0
#: Examples of each test in CI, and in `make verify`.
FEW, MANY = 20, 420

_verdicts = MPI.COMM_WORLD.Dup()


class TooLong(BaseException):
    """A case that hangs. No Exception, so that nothing swallows it."""


@contextlib.contextmanager
def limited(seconds=LIMIT):
    """Raise TooLong in what takes longer."""

    def ring(number, frame):
        raise TooLong(f"over {seconds:g} s")

    old = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, old)


def examples(count):
    """Settings of a fuzz test with that many examples."""
    checks = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture, HealthCheck.data_too_large,
              HealthCheck.filter_too_much, HealthCheck.large_base_example]  # fmt: skip
    return settings(max_examples=count, suppress_health_check=checks, deadline=None)


def told(case, bad=True):
    """The kind of error that a case ends with, "fine" if none; the same on all ranks.

    Args:
        case: A function of nothing.
        bad: Whether it must be refused.
    """
    kind, message, other = "fine", "", None
    try:
        with warnings.catch_warnings(), limited():
            warnings.simplefilter("ignore")
            case()
    except ComplexBodyError as error:
        kind, message = type(error).__name__, str(error)
    except BaseException as error:
        kind, other = f"{type(error).__name__}: {error}", error
    everyone, deadline = _verdicts.Ibarrier(), time.monotonic() + LIMIT
    while not everyone.Test():
        if time.monotonic() > deadline:
            os.write(2, f"rank {_verdicts.rank}: {kind} {message}; others wait\n".encode())
            _verdicts.Abort(1)
        time.sleep(1e-4)
    if other is not None:
        raise other
    kinds = _verdicts.allgather((kind, message))
    assert len({k for k, _ in kinds}) == 1, f"ranks differ: {kinds}"
    if kind == "fine":
        assert not bad, "a bad input was taken"
    else:
        advice = re.search(rf"(^|[.:;,] |or )({_VERBS})\b", message, re.I)
        assert advice, f"no advice in {kind}: {message}"
    return kind


@contextlib.contextmanager
def silent():
    """Standard output and error as one text buffer each."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        yield out, err


class Odd:
    """An object of no use, whose text cannot be had either."""

    def __repr__(self):
        return "<odd>"


def endless(*arguments):
    """Infinite recursion."""
    return endless(*arguments)


def raising(error):
    """A function of anything that raises."""

    def function(*arguments):
        raise error

    return function


#: Functions that fail in every way a function can.
FAILING = [
    raising(e) for e in (
        ZeroDivisionError("mine"), KeyError("mine"), ValueError(), MemoryError(), RuntimeError("x"),
        StopIteration(), AssertionError("mine"), NotImplementedError(), OSError(5, "mine"),
        UnicodeDecodeError("utf-8", b"x", 0, 1, "mine"), Exception("ünïcode\n\n\ttext"), Warning(),
        ExceptionGroup("many", [ValueError("one")]), RuntimeWarning("mine"), ImportError("x"),
    )
] + [endless, lambda: None]  # fmt: skip

#: No numbers.
NO_NUMBERS = [
    None, "1", "steel", "", b"1", [], {}, (), set(), Odd(), float, range(0), 1j, complex("nan"),
    [[1.0], [1.0, 2.0]], np.array("a"), np.array([None]), np.datetime64("NaT"), Ellipsis,
    slice(1), np.ma.masked, np.array([]), np.array([[]]), {"a": 1}, True, False, np.bool_(True),
    np.array(1j), np.array(True), iter(()), "1e3", "nan",
]  # fmt: skip
#: Numbers that are none of physics.
WILD = [np.nan, np.inf, -np.inf, np.float64("nan"), np.float32("inf"), 10**400, -(10**400)]

no_numbers = st.sampled_from(NO_NUMBERS)
wild = st.sampled_from(WILD)
negative = st.one_of(
    st.floats(max_value=-1e-300, allow_infinity=False), st.integers(max_value=-1),
    st.sampled_from([fractions.Fraction(-1, 3), np.float32(-1), np.int8(-1)]),
)  # fmt: skip
not_positive = st.one_of(negative, st.sampled_from([0, 0.0, -0.0, np.float64(0), np.int64(0)]))
not_a_count = st.one_of(
    st.integers(max_value=0), no_numbers, wild, st.sampled_from([1.5, 2.0, "2", np.float64(3)])
)
failing = st.sampled_from(FAILING)

#: A scene file that runs.
GOOD = """
import numpy as np
import complexbody as cb
import ufl
from complexbody import meshes
from complexbody.forms import isotropic_two_field

DEFAULTS = dict(until=0.02, every=0.01)
history, where, load, start = cb.constant(), (lambda x: x[0] < 1e-9), (1.0,), None

def scene(comm, cells=8):
    return cb.Scene(
        meshes.interval(comm, 0.0, 1.0, cells), isotropic_two_field(d=1),
        supports=[cb.Fix("u", where=where)], loads=[cb.BodyForce(load, history=history)],
        initial=cb.Initial(u=start),
    )
"""


def judged(words, out):
    """Run main, and judge its end; the exit code."""
    shutil.rmtree(out, ignore_errors=True)
    with silent() as (_, err), limited():
        code = main(words)
    told = err.getvalue()
    assert code in (0, 2, 3, 4, 5, 130), told
    assert "Traceback" not in told, told
    if code == 0:
        return code
    assert "complexbody: " in told and told.endswith("\n")
    record = out / "run.json"
    if record.exists():
        assert json.loads(record.read_text())["state"] != "finished"
    else:
        assert not list(out.glob("*")) if out.exists() else True
    return code
