# SPDX-License-Identifier: LGPL-3.0-or-later
"""Compiled once per content, safe when many ask at once, clear when it cannot work."""

import contextlib
import ctypes
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import time

import numpy as np
import pytest
from harness import everywhere, refused

from complexbody import native
from complexbody.errors import ComplexBodyError, MissingPackage

load = native.load.__wrapped__  # without the memory of this process


def source(number):
    """C that nobody else compiles."""
    return f"/* tests/test_native.py */ int answer(void) {{ return {number}; }}"


@pytest.fixture
def cache(monkeypatch, tmp_path):
    """An empty cache of this rank."""
    monkeypatch.setenv("COMPLEXBODY_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_one_library_per_content(cache, monkeypatch):
    """Another source, flag, compiler or CPU is another file; the same content is not compiled."""
    assert load(source(1)).answer() == 1
    assert len(list(cache.iterdir())) == 1
    assert load(source(2)).answer() == 2
    assert len(list(cache.iterdir())) == 2
    monkeypatch.setattr(native, "FLAGS", (*native.FLAGS, "-DOTHER"))
    load(source(1))
    assert len(list(cache.iterdir())) == 3
    path, version = native.compiler()
    monkeypatch.setattr(native, "compiler", lambda: (path, version + " patched"))
    load(source(1))
    assert len(list(cache.iterdir())) == 4
    monkeypatch.setattr(native, "cpu_flags", lambda: frozenset(["another"]))
    load(source(1))
    files = list(cache.iterdir())
    assert len(files) == 5
    assert all(f.name.startswith("kernel-") and f.suffix == ".so" for f in files)

    def never(*arguments):
        raise AssertionError("compiled again")

    monkeypatch.setattr(native, "_compile", never)
    assert load(source(1)).answer() == 1
    with pytest.raises(AssertionError, match="compiled again"):
        load(source(3))


def test_a_library_appears_whole(cache, monkeypatch):
    """By renaming: what is cut short before leaves nothing that could be taken for it."""

    def killed(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        load(source(10))
    assert not list(cache.iterdir())


def test_one_library_per_process(cache, monkeypatch):
    """The same source gives the same library object."""
    text = source(4)
    assert native.load(text) is native.load(text)


def _ask(folder, barrier, answers):
    os.environ["COMPLEXBODY_CACHE"] = folder
    barrier.wait()
    answers.put(load(source(5)).answer())


@pytest.mark.serial
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_processes_that_ask_at_once(tmp_path):
    """All get a whole library; one file is left, and nothing half made."""
    context = multiprocessing.get_context("fork")  # a child makes no MPI call
    barrier, answers = context.Barrier(4), context.Queue()
    arguments = (str(tmp_path), barrier, answers)
    children = [context.Process(target=_ask, args=arguments) for _ in range(4)]
    for child in children:
        child.start()
    found = [answers.get(timeout=60) for _ in children]
    for child in children:
        child.join(60)
    assert found == [5, 5, 5, 5] and [child.exitcode for child in children] == [0, 0, 0, 0]
    assert [path.suffix for path in tmp_path.iterdir()] == [".so"]


def test_ranks_that_ask_at_once(comm, shared_path, monkeypatch):
    monkeypatch.setenv("COMPLEXBODY_CACHE", str(shared_path / "cache"))
    comm.barrier()
    answer = load(source(6)).answer()
    comm.barrier()
    assert everywhere(comm, answer == 6)
    assert [path.suffix for path in (shared_path / "cache").iterdir()] == [".so"]
    comm.barrier()


@pytest.mark.parametrize("keep", [0, 40, 1000, 0.5, -1, "flip"])
def test_damaged_libraries_are_compiled_anew(cache, keep):
    """Cut short anywhere, or a bit changed: never loaded, for the loader would crash."""
    load(source(20))
    (library,) = cache.iterdir()
    content = library.read_bytes()
    if keep == "flip":
        middle = len(content) // 2
        damaged = content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]
    else:
        damaged = content[: int(keep * len(content)) if isinstance(keep, float) else keep]
    library.unlink()  # this process has the old one mapped
    library.write_bytes(damaged)
    assert load(source(20)).answer() == 20
    assert native._is_whole(library) and len(list(cache.iterdir())) == 1


def test_no_space_for_kernels(cache, monkeypatch):
    """The compiler's scratch folder cannot be made: told with the cache's name."""

    def full(*arguments, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tempfile, "TemporaryDirectory", full)
    with refused(ComplexBodyError, "No space left on device", str(cache), "COMPLEXBODY_CACHE"):
        load(source(21))


@pytest.mark.serial
def test_a_killed_compile_leaves_nothing_that_is_taken(tmp_path):
    """A process killed while the compiler runs: the next one compiles, and has the answer."""
    slow = tmp_path / "cc"
    slow.write_text(
        '#!/bin/sh\ncase "$1" in --version) echo slow;; *) echo $$ >'
        f" {tmp_path}/started; sleep 60;; esac\n"
    )
    slow.chmod(0o755)
    text = f"from complexbody import native; native.load({source(22)!r})"
    environment = dict(os.environ, COMPLEXBODY_CACHE=str(tmp_path / "cache"), CC=str(slow))
    child = subprocess.Popen([sys.executable, "-c", text], env=environment)
    deadline = time.monotonic() + 60
    while not (tmp_path / "started").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    child.kill()
    child.wait(10)
    with contextlib.suppress(ValueError, ProcessLookupError):
        os.kill(int((tmp_path / "started").read_text()), signal.SIGKILL)
    environment.pop("CC")
    done = subprocess.run(
        [sys.executable, "-c", f"{text}; print(native.load({source(22)!r}).answer())"],
        env=environment, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.stdout == "22\n", done.stderr


@pytest.mark.parametrize("name", ["no-such-cc", "/nowhere/gcc -m64"])
def test_no_compiler(cache, monkeypatch, name):
    """What is missing and how to get it; nothing is written."""
    monkeypatch.setenv("CC", name)
    monkeypatch.setattr(native, "compiler", native.compiler.__wrapped__)
    with refused(MissingPackage, f"'{name}'", "apt install gcc"):
        load(source(7))
    assert MissingPackage.exit_code == 3
    assert not cache.exists() or not list(cache.iterdir())


def test_compiler_of_the_user(monkeypatch, tmp_path):
    """$CC is asked for its version, and part of the key."""
    script = tmp_path / "mycc"
    script.write_text("#!/bin/sh\necho mycc 1.2.3\n")
    script.chmod(0o755)
    monkeypatch.setenv("CC", str(script))
    assert native.compiler.__wrapped__() == (str(script), "mycc 1.2.3")


def test_broken_source(cache):
    """The compiler's own words, where it said them, and no file that would be found next time."""
    for _ in range(2):
        with refused(ComplexBodyError, "generated kernel", "undeclared_thing", "error"):
            load("int f(void) { return undeclared_thing; }")
        assert not list(cache.iterdir())


def test_cache_that_cannot_be_written(monkeypatch, tmp_path):
    """As on a read-only home: a folder of the user's in the temporary one, closed to others."""
    (tmp_path / "file").write_text("")
    (tmp_path / "tmp").mkdir()
    monkeypatch.setenv("COMPLEXBODY_CACHE", str(tmp_path / "file" / "cache"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    with pytest.warns(UserWarning, match="cannot be written.*Set COMPLEXBODY_CACHE"):
        assert load(source(8)).answer() == 8
    (folder,) = (tmp_path / "tmp").iterdir()
    assert folder.name == f"complexbody-{os.getuid()}"
    assert folder.stat().st_mode & 0o077 == 0
    assert [path.suffix for path in folder.iterdir()] == [".so"]


def test_cache_folder(monkeypatch, tmp_path):
    """$COMPLEXBODY_CACHE, else $XDG_CACHE_HOME, else ~/.cache."""
    monkeypatch.setenv("COMPLEXBODY_CACHE", str(tmp_path / "own"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert native.cache_folder() == tmp_path / "own"
    monkeypatch.delenv("COMPLEXBODY_CACHE")
    assert native.cache_folder() == tmp_path / "xdg" / "complexbody"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert native.cache_folder() == tmp_path / "home" / ".cache" / "complexbody"


@pytest.mark.parametrize("shape", [(7,), (3, 5), (0, 4), (2, 3, 8)])
def test_aligned(shape):
    """Zeros from a 64-byte boundary on, with room for one vector behind them."""
    arrays = [native.aligned(shape) for _ in range(5)]
    for array in arrays:
        assert array.shape == shape and array.dtype == np.float64 and array.flags.c_contiguous
        assert array.ctypes.data % 64 == 0 or not array.size
        assert not array.any() and array.flags.writeable
        buffer = array
        while buffer.base is not None:
            buffer = buffer.base
        end = buffer.ctypes.data + buffer.nbytes
        assert end - (array.ctypes.data + array.nbytes) >= 64
    arrays[0][...] = 1.0
    assert not any(array.any() for array in arrays[1:])
    assert native.aligned((5,), np.int32).nbytes == 20


def test_pointer():
    """Of contiguous arrays only."""
    array = np.arange(6.0).reshape(2, 3)
    assert native.pointer(array).value == array.ctypes.data
    assert native.pointer(None).value is None
    with pytest.raises(AssertionError):
        native.pointer(array.T)
    back = ctypes.cast(native.pointer(array), ctypes.POINTER(ctypes.c_double))
    assert back[4] == 4.0


def test_lanes():
    """Eight doubles need AVX-512."""
    expected = 8 if "avx512f" in native.cpu_flags() else 4
    assert native.lanes() == expected


def test_a_compiled_library_is_quick_to_find(cache):
    """Loading what is cached costs no compilation."""
    load(source(9))
    begun = time.perf_counter()
    load(source(9))
    assert time.perf_counter() - begun < 0.05
