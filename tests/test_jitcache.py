"""FFCx's cache after killed compiles, damage, and among processes that compile at once."""

import multiprocessing
import os
import re
import subprocess
import sys
import time

import numpy as np
import pytest
import ufl
from dolfinx import fem
from harness import everywhere, refused

from complexbody import _compat, jitcache, meshes, native
from complexbody.errors import ComplexBodyError


@pytest.fixture
def cache(comm, monkeypatch, shared_path):
    """An empty cache, the same one for all ranks."""
    monkeypatch.setenv("COMPLEXBODY_CACHE", str(shared_path / "cache"))
    return jitcache.folder()


def integral(mesh, number):
    """A form of its own by number, and what it is worth."""
    x = ufl.SpatialCoordinate(mesh)
    return _compat.form((number + x[0]) * ufl.dx(domain=mesh)), number + 0.5


def worth(comm, mesh, number):
    form, known = integral(mesh, number)
    return everywhere(comm, abs(comm.allreduce(fem.assemble_scalar(form)) - known) < 1e-12)


def test_the_cache_is_keyed_by_cpu(monkeypatch, cache):
    assert cache.parent == native.cache_folder()
    monkeypatch.setattr(native, "cpu_flags", lambda: frozenset(["another"]))
    assert jitcache.folder() != cache and jitcache.folder().parent == cache.parent


@pytest.mark.parametrize("what", ["killed at once", "killed in the compiler", "cut", "emptied"])
def test_what_others_left_on_any_rank(comm, cache, what):
    """Half made or damaged modules are compiled again, without waiting for whoever has gone."""
    mesh = meshes.interval(comm, 0.0, 1.0, 3 * comm.size)
    assert worth(comm, mesh, 17)
    comm.barrier()
    if comm.rank == 0:
        (source,) = cache.glob("libffcx_forms_*.c")
        (library,) = cache.glob(f"{source.stem}.*so")
        if what.startswith("killed"):
            source.with_suffix(".c.cached").unlink()
        content = library.read_bytes()
        library.unlink()
        if what == "killed at once":
            source.write_text("")
        if what in ("cut", "killed in the compiler"):
            library.write_bytes(content[: len(content) // 2])
        if what == "emptied":
            library.write_bytes(b"")
    comm.barrier()
    begun = time.monotonic()
    assert worth(comm, mesh, 17)
    assert time.monotonic() - begun < 60  # FFCx would wait for 120 s, and give up


def test_whole(cache, comm, tmp_path):
    """A library that was cut anywhere is not."""
    mesh = meshes.interval(comm, 0.0, 1.0, 3 * comm.size)
    assert worth(comm, mesh, 19)
    (library,) = cache.glob("libffcx_forms_*so")
    content, copy = library.read_bytes(), tmp_path / "copy.so"
    for length in np.linspace(0, len(content) - 1, 50).astype(int):
        copy.write_bytes(content[:length])
        assert not jitcache.whole(copy), length
    copy.write_bytes(content)
    assert jitcache.whole(copy)
    comm.barrier()


def test_forms_that_cannot_be_compiled_on_any_rank(comm, cache, monkeypatch):
    """After a second attempt, with the folder's name; on all ranks."""
    calls = []

    def make(place):
        calls.append(place)
        raise OSError(28, "No space left on device")

    with refused(ComplexBodyError, "No space left on device", "Check", str(cache)):
        jitcache.compiled(comm, make)
    assert calls == [str(cache)] * 2


def test_young_ones_are_waited_for(tmp_path, monkeypatch):
    """Outside the lock only what has not changed for long counts as left behind."""
    (tmp_path / "libffcx_elements_a.c").write_text("")
    assert jitcache.heal(tmp_path, age=30.0) == []
    os.utime(tmp_path / "libffcx_elements_a.c", (1, 1))
    assert jitcache.heal(tmp_path, age=30.0) == ["libffcx_elements_a"]
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "libffcx_elements_b.c").write_text("")
    monkeypatch.setattr(jitcache, "OLD", 0.5)
    jitcache.wait_and_heal(tmp_path)
    assert list(tmp_path.iterdir()) == []


def _hold(place, barrier):
    with jitcache.locked(place):
        barrier.wait()
        time.sleep(60)


@pytest.mark.serial
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_the_lock_dies_with_who_holds_it(tmp_path, monkeypatch):
    context = multiprocessing.get_context("fork")
    barrier = context.Barrier(2)
    child = context.Process(target=_hold, args=(tmp_path, barrier))
    child.start()
    barrier.wait()
    monkeypatch.setattr(jitcache, "PATIENCE", 0.2)
    with jitcache.locked(tmp_path) as held:
        assert not held
    child.kill()
    child.join(10)
    with jitcache.locked(tmp_path) as held:
        assert held


RUN = """
import numpy as np, complexbody as cb
from mpi4py import MPI
from complexbody import meshes
from complexbody.forms import isotropic_two_field
import ufl
def energy(U, nu, N):
    return ufl.inner(U, U) + ufl.inner(U, U) ** 2 + ufl.inner(N, N)
mesh = meshes.rectangle(MPI.COMM_SELF, (0, 0), (1, 1), (4, 4))
scene = cb.Scene(mesh, cb.Body(1, energy, 1.0, 1.0), initial=cb.Initial(u=lambda x: 1e-2 * x))
result = cb.simulate(scene, until=0.1)
print("norm %.12e" % np.linalg.norm(result.u.x.array))
"""


def _start(folder, **more):
    environment = dict(os.environ, XDG_CACHE_HOME=str(folder), COMPLEXBODY_CACHE="", **more)
    return subprocess.Popen(
        [sys.executable, "-c", RUN], env=environment, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


def _norm(child):
    out, err = child.communicate(timeout=400)
    assert child.returncode == 0, err
    return re.search(r"norm (\S+)", out)[1], err


@pytest.mark.serial
@pytest.mark.slow
def test_first_runs_at_once_after_killed_ones(tmp_path):
    """Four kills at different moments of a first run, then three runs at once: all succeed."""
    for seconds in (3.0, 5.0, 8.0, 12.0):
        child = _start(tmp_path / "home")
        time.sleep(seconds)
        child.kill()
        child.communicate()
    children = [_start(tmp_path / "home") for _ in range(3)]
    norms = {_norm(child)[0] for child in children}
    assert len(norms) == 1
    assert {_norm(_start(tmp_path / "other"))[0]} == norms


@pytest.mark.serial
@pytest.mark.slow
def test_a_home_that_cannot_be_written(tmp_path):
    """A file where the cache should be: the temporary folder is used, and told."""
    (tmp_path / "home").write_text("")
    (tmp_path / "tmp").mkdir()
    _, err = _norm(_start(tmp_path / "home", TMPDIR=str(tmp_path / "tmp")))
    assert "cannot be written" in err and str(tmp_path / "tmp") in err
    assert list((tmp_path / "tmp").glob("complexbody-*/kernel-*.so"))
