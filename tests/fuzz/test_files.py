"""Scene files that are none, whatever is in them: typed errors, and no result that is none."""

import pytest
from fuzzing import FEW, GOOD, MANY, examples, judged
from hypothesis import given
from hypothesis import strategies as st

#: Statements, each of which spoils the file.
BREAKS = [
    "1 / 0", "import no_such_module", "raise SystemExit", "import sys; sys.exit('text')",
    "import sys; sys.exit(0)", "raise GeneratorExit", "class Mine(BaseException): pass\nraise Mine",
    "class Odd(Exception):\n    def __str__(self): return 1 / 0\nraise Odd", "def f(): f()\nf()",
    "x = [", "def scene(comm:", "\tx = 1\n  y", "return 3", "yield 3", "await x", "break",
    "λ = = 3",
    "raise AssertionError", "raise StopIteration", "raise MemoryError", "assert False, 'no'",
    "from complexbody import nothing", "del scene", "scene = 3", "scene = None", "scene = cb.Scene",
    "def scene(): return 3", "def scene(comm): return 3", "def scene(comm): return None",
    "def scene(comm, cells): return 3", "def scene(*, comm): return 3",
    "def scene(comm): return 1/0",
    "def scene(comm): raise SystemExit(0)", "def scene(comm): import sys; sys.exit()",
    "async def scene(comm): return 3", "def scene(comm): yield 3", "class scene: pass",
    "def scene(comm): return scene(comm)", "def scene(comm): return cb.Scene",
    "def scene(comm): raise GeneratorExit", "def scene(comm): return cb.Scene(None, None)",
    "def scene(comm): raise BaseException('mine')", "scene = lambda: 1", "scene = print",
    "def scene(comm): return (cb.Scene,)", "def scene(comm):\n    x", "scene = 'scene'",
    "def scene(comm): return isotropic_two_field(d=1)", "def scene(comm): return comm",
    "def scene(comm): raise KeyError", "def scene(comm): raise ExceptionGroup('m', [ValueError()])",
    "DEFAULTS = 3", "DEFAULTS = None", "DEFAULTS = []", "DEFAULTS = dict(untill=1)",
    "DEFAULTS = {1: 2}", "DEFAULTS = dict(until='soon')", "DEFAULTS = dict(until=-1.0)",
    "DEFAULTS = dict(until=None)", "DEFAULTS = dict(until=float('nan'))", "DEFAULTS = {None: 1}",
    "DEFAULTS = dict(until=0.02, every=-1)", "DEFAULTS = dict(until=0.02, every='x')",
    "DEFAULTS = dict(until=0.02, integrator='none')", "DEFAULTS = dict(until=0.02, integrator=3)",
    "DEFAULTS = dict(until=0.02, integrator=[])", "DEFAULTS = dict(until=0.02, step='x')",
    "DEFAULTS = dict(until=0.02, step=-1)", "DEFAULTS = dict(until=0.02, fields=3)",
    "DEFAULTS = dict(until=0.02, fields=['x'])", "DEFAULTS = dict(until=0.02, probes=3)",
    "DEFAULTS = dict(until=0.02, probes={'a': 'b'})", "DEFAULTS = dict(until=0.02, probe_steps=0)",
    "DEFAULTS = dict(until=0.02, ledger_steps=1.5)",
    "DEFAULTS = dict(until=0.02, times='x')", "DEFAULTS = dict(until=0.02, safety='x')",
    "DEFAULTS = dict(until=0.02, levels=1)", "DEFAULTS = dict(until=0.02, dissipation=3)",
    "DEFAULTS = dict(until=0.02, unstable_ok='maybe')", "DEFAULTS = dict(until=1e300)",
    "DEFAULTS = dict(until=0.02, ledger_steps=True)", "DEFAULTS = dict(until=10**400)",
    "history = 3", "history = lambda t: 1 / 0", "history = lambda t: t * float('nan')",
    "def history(t): raise SystemExit", "def history(t): raise SystemExit(0)", "where = None",
    "def history(t): import sys; sys.exit(0)", "where = 7", "where = lambda x: 1 / 0",
    "def where(x): raise SystemExit(0)", "where = lambda x: x[0] > 9", "where = lambda x: None",
    "def where(x): raise GeneratorExit", "load = 'x'", "load = (1.0, 2.0)", "load = (np.nan,)",
    "load = lambda x: 1 / 0", "def load(x): raise SystemExit(0)", "start = 'x'", "start = np.nan",
    "start = lambda x: x[0] / 0 * 0", "def start(x): raise SystemExit(0)", "start = (1.0, 2.0)",
    "def check(result): assert False", "def check(result): return 1 / 0", "def check(): pass",
    "def check(result): raise SystemExit(0)", "def check(result): result.nothing",
    "def picture(result, path): return 1 / 0", "def picture(): pass",
    "def picture(result, path): raise SystemExit(0)", "def check(result): raise GeneratorExit",
    "def history(t):\n    if np.max(t) > 0.019: raise SystemExit(0)\n    return np.ones_like(t)",
    "def where(x): raise KeyboardInterrupt", "def history(t): raise BaseException('mine')",
    "def check(result): raise BaseException('mine')", "def where(x): raise BaseException('mine')",
    "calls = []\ndef history(t):\n    calls.append(t)\n    if len(calls) > 4: raise SystemExit(0)"
    "\n    return np.ones_like(t)",
    "calls = []\ndef history(t):\n    calls.append(t)\n    if len(calls) > 4: raise KeyError"
    "\n    return np.ones_like(t)",
]  # fmt: skip
#: Statements that do no harm, or may.
NOISE = [
    "print('hello')", "import warnings; warnings.warn('mind')", "x = 1", "", "# comment", "'text'",
    "__all__ = []", "__name__ = 'x'", "import sys; print('e', file=sys.stderr)", "import os",
    "assert True", "def picture(result, path): pass", "cb.also = 3", "π = 3.14",
    "def exact(t): 1",
]  # fmt: skip


@pytest.mark.serial
@pytest.mark.parametrize("count", [FEW, pytest.param(MANY, marks=pytest.mark.slow)])
def test_broken_scene_files(tmp_path, count):
    """Each has at least one statement that no run survives."""
    codes, path, out = [], tmp_path / "file.py", tmp_path / "out"
    statement = st.sampled_from(BREAKS)

    @examples(count)
    @given(st.lists(st.sampled_from(NOISE), max_size=2), statement, st.none() | statement,
           st.sampled_from(["run", "run", "run", "check", "plan"]), st.booleans())  # fmt: skip
    def one(noise, broken, more, command, first):
        parts = [*noise, broken, *([more] if more else [])]
        text = [*parts, GOOD] if first and "cb." not in broken else [GOOD, *parts]
        path.write_text("\n".join(text), encoding="utf-8")
        words = [command, str(path), *(["--out", str(out)] if command == "run" else [])]
        codes.append(judged(words, out))
        # Definitions that come first are overridden by good ones; check and plan do not run.
        if command == "run" and text[0] is GOOD and not more:
            assert codes[-1] != 0, broken

    one()
    assert len(codes) >= count


@pytest.mark.serial
@pytest.mark.parametrize("count", [FEW, pytest.param(MANY, marks=pytest.mark.slow)])
def test_garbage_for_scene_files(tmp_path, count):
    """Any bytes, and the good file with some bytes changed or cut off."""
    codes, path, out = [], tmp_path / "file.py", tmp_path / "out"
    good = GOOD.encode()
    cut = st.integers(0, 300).map(lambda n: good[:n])
    junk = st.one_of(st.binary(max_size=60), cut, st.text(max_size=40).map(str.encode))

    @examples(count)
    @given(junk)
    def one(content):
        path.write_bytes(content)
        codes.append(judged(["run", str(path), "--out", str(out)], out))
        assert codes[-1] == 2

    one()
    assert len(codes) >= count
