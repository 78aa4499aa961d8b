"""Shared by all tests: the communicator, and one verdict of all ranks.

Under mpirun every rank runs the same tests in the same order. A test that fails on one rank fails
on all of them, else they would part ways and wait for each other for ever. Rank 0 prints what
pytest prints; the others write it to build/test-logs/rank-R.log.
"""

import math
import os
import sys
import time
import zlib
from pathlib import Path

import hypothesis
import pytest
from mpi4py import MPI

BUILD = Path(__file__).parents[1] / "build"
PATIENCE = 60.0  # seconds that a failed rank waits for the others, which may wait for it

_ranks = MPI.COMM_WORLD.Dup()  # apart from the tests' own messages
_parallel = _ranks.size > 1
_stderr = 2
_broken = []

# Ranks must draw the same examples, and CI the same as the last time (which goes without a database
# of earlier failures). No deadline: compiling a form takes long.
_repeatable = _parallel or "CI" in os.environ
hypothesis.settings.register_profile(
    "complexbody",
    deadline=None,
    derandomize=_repeatable,
    **({"database": None} if _repeatable else {}),
)
hypothesis.settings.load_profile("complexbody")


@pytest.fixture(scope="session")
def comm():
    """All ranks."""
    return MPI.COMM_WORLD


@pytest.fixture
def shared_path(comm, tmp_path):
    """One temporary directory for all ranks (tmp_path is each rank's own)."""
    return comm.bcast(tmp_path)


def _gather(value, failure=""):
    """Every rank's value; after a failure not waiting for ever."""
    everyone = _ranks.Ibarrier()
    deadline = time.monotonic() + PATIENCE if failure else math.inf
    while not everyone.Test():
        if time.monotonic() > deadline:
            text = f"rank {_ranks.rank} failed and the others wait for it:\n{failure}\n"
            os.write(_stderr, text.encode())
            _ranks.Abort(1)
        time.sleep(1e-3)
    return _ranks.allgather(value)


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config):
    """Give all ranks but the first an output and temporary files of their own."""
    global _stderr
    _stderr = os.dup(2)  # pytest captures descriptor 2 during tests
    if _ranks.rank > 0:
        log = BUILD / "test-logs" / f"rank-{_ranks.rank}.log"
        log.parent.mkdir(parents=True, exist_ok=True)
        # The terminal reporter, configured next, keeps the stream that it finds here.
        sys.stdout = log.open("w", buffering=1)
        # pytest clears old temporary directories away: two that do so at once get in each other's
        # way, and the warning ends the run.
        temporary = BUILD / "test-tmp" / f"rank-{_ranks.rank}"
        temporary.mkdir(parents=True, exist_ok=True)
        os.environ["PYTEST_DEBUG_TEMPROOT"] = str(temporary)


def pytest_addoption(parser):
    """``--sample N``: one of N tests, ``--about N``: of those about ranks; the same every time."""
    parser.addoption("--sample", type=int, default=1, metavar="N", help="run one of N tests")
    parser.addoption("--about", type=int, default=1, metavar="N", help="of those about ranks")


def pytest_collection_modifyitems(config, items):
    """Leave `serial` tests out under mpirun, and what is not in the sample."""
    part, about = config.getoption("--sample"), config.getoption("--about")
    if max(part, about) > 1:
        parts = [about if "rank" in item.nodeid else part for item in items]
        chosen = [
            item for item, part in zip(items, parts, strict=True)
            if zlib.crc32(item.nodeid.encode()) % part == 0
        ]  # fmt: skip
        config.hook.pytest_deselected(items=[item for item in items if item not in chosen])
        items[:] = chosen
    if _parallel:
        for item in items:
            if item.get_closest_marker("serial"):
                item.add_marker(pytest.mark.skip(reason="serial: not under mpirun"))


def pytest_collectreport(report):
    """Keep what went wrong, for rank 0 to tell."""
    if report.failed:
        _broken.append(f"rank {_ranks.rank}: {report.longreprtext}")


def pytest_collection_finish(session):
    """Stop if ranks are about to run different tests."""
    if not _parallel:
        return
    collected, broken = zip(
        *_gather(([item.nodeid for item in session.items], "\n".join(_broken))), strict=True
    )
    if any(nodes != collected[0] for nodes in collected):
        pytest.exit("\n".join(("the ranks collected different tests", *broken)), 1)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_makereport(item, call):
    """Give a test the same outcome on all ranks."""
    report = yield
    if not _parallel:
        return report
    text = report.longreprtext if report.failed else ""
    outcomes, texts = zip(
        *_gather((report.outcome, text), text and f"{item.nodeid}\n{text}"), strict=True
    )
    if len(set(outcomes)) > 1:
        told = [f"rank {rank} {outcomes[rank]}\n{texts[rank]}" for rank in range(_ranks.size)]
        told = "\n".join(sorted(told, key=lambda line: line.split()[2] != "failed"))
        if report.failed:
            report.sections.append(("all ranks", told))
        else:
            report.outcome, report.longrepr = "failed", told
            report.__dict__.pop("wasxfail", None)
    return report


@pytest.hookimpl(trylast=True)
def pytest_unconfigure():
    """Leave together: mpirun ends all ranks as soon as one has left with a failure."""
    if _parallel:
        _gather(None, "it ended early")
