"""Words on the command line in any order: an exit code and one message, never a traceback."""

import os

import pytest
from fuzzing import FEW, GOOD, MANY, examples, judged
from hypothesis import given
from hypothesis import strategies as st

NUMBERS = ["0.5", "2e-3", "0", "-1", "nan", "inf", "-inf", "1e400", "x", "", "1_0", "½", "1,5"]
WORDS = ["", "x", "--", "-", "é", "\n", "a b", "../..", "--help ", "None", "[]", "=", "\t", "'"]
OPTIONS = {
    "--until": ["0.01", *NUMBERS], "--step": ["1e-3", "1e300", *NUMBERS], "--safety": NUMBERS,
    "--integrator": ["synchronous", "avi", "local-leapfrog", "implicit", "assembled-leapfrog",
                     "newmark", "petsc-ts", *WORDS],
    "--dissipation": ["exact", "forward", "symmetric", *WORDS], "--start": ["one-sided", *WORDS],
    "--critical": ["cells", "global", *WORDS],
    "--schedule": ["windows", "exact", "octaves", *WORDS],
    "--stabilisation": NUMBERS, "--order": ["1", "2", "3", *NUMBERS], "--levels": ["1", *NUMBERS],
    "--forces": ["implicit", *WORDS], "--quadrature": ["vertex", "consistent", *WORDS],
    "--tolerance": NUMBERS, "--petsc": ["ksp_type=no", "ksp_rtol=x", *WORDS],
    "--force": ["matrix", *WORDS], "--kind": ["rk4", "cn", *WORDS], "--every": ["0.005", *NUMBERS],
    "--fields": ["u", "none", "stress,u", "u,u", ",", *WORDS], "--probe": [
        "a=0.5", "a=", "a=nan", "a=9", "=0.5", "a=0.5,0.5", "a/b=0.5", "..=0.5", "a\0=0.5", *WORDS],
    "--probe-steps": ["3", "1.5", *NUMBERS], "--ledger-steps": ["3", "1.5", *NUMBERS],
    "--accuracy": ["2", *NUMBERS],
    "--set": ["cells=8", "cells=0", "cells=-1", "cells=1e99", "cells=nan", "cells=()", "cells=x",
              "cells=1.5", "cells=None", "x=1", "=3", "cells", "cells=" + "[" * 300, *WORDS],
    "--corrected": None, "--balanced": None, "--no-balanced": None, "--unstable-ok": None,
    "--no-plan": None, "--no-picture": None, "--quiet": None, "--speed-up": None, "--monitor": None,
    "--nonsense": None, "-x": None, "--debugg": None, "extra": None,
}  # fmt: skip
#: Each must be refused, whatever else is asked for.
ALWAYS_WRONG = [
    ["--nonsense"], ["--until", "x"], ["--until", "-1"], ["--until", "nan"], ["--step", "nan"],
    ["--integrator", "rk4"], ["--fields", "w"], ["--set", "cells=x"], ["--set", "x=1"], ["extra"],
    ["--set", "="], ["--probe", "a=nan"], ["--ledger-steps", "0"], ["--every", "-1"], ["--until"],
]  # fmt: skip


@st.composite
def soups(draw):
    """Words after the file's name, and whether they must be refused."""
    words, bad = [], draw(st.booleans())
    for name in draw(st.lists(st.sampled_from(sorted(OPTIONS)), max_size=4)):
        values = OPTIONS[name]
        words.append(name)
        if values is not None and draw(st.integers(0, 12)):
            few = st.sampled_from(values[:3])  # most of which are good, so that runs get far
            words.append(draw(few | few | few | st.sampled_from(values)))
    if bad:
        words += draw(st.sampled_from(ALWAYS_WRONG))
    return words, bad


@pytest.mark.serial
@pytest.mark.parametrize("count", [FEW, pytest.param(MANY, marks=pytest.mark.slow)])
def test_option_soup(tmp_path, count):
    """Options of run in any mixture; those that must be refused are."""
    codes, path, out = [], tmp_path / "file.py", tmp_path / "out"
    path.write_text(GOOD, encoding="utf-8")

    @examples(count)
    @given(soups(), st.sampled_from(["run", "run", "check", "plan"]))
    def one(soup, command):
        words, bad = soup
        where = ["--out", str(out)] if command == "run" else []
        codes.append(judged([command, str(path), *where, *words], out))
        # A value may swallow the option that is wrong; then the next word stands alone.
        if bad and "--debug" not in words:
            assert codes[-1] != 0, words

    one()
    assert len(codes) >= count


@pytest.mark.serial
@pytest.mark.parametrize("count", [FEW, pytest.param(MANY, marks=pytest.mark.slow)])
def test_commands_and_paths(tmp_path, count):
    """Unknown commands, files and folders that cannot be read or written."""
    codes, good, out = [], tmp_path / "file.py", tmp_path / "out"
    good.write_text(GOOD, encoding="utf-8")
    (tmp_path / "folder").mkdir()
    (tmp_path / "text.txt").write_text("no scene")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    os.mkfifo(tmp_path / "pipe.d")
    names = ["folder", "text.txt", "nowhere.py", "loop", "text.txt/x.py", "", "a" * 300, "x\ty"]
    files = [str(tmp_path / name) for name in names] + ["/dev/null", "/proc/self/mem", "", "-", "."]
    outs = ["/proc/x", "/dev/null", str(tmp_path / "text.txt"), str(tmp_path / "loop"),
            str(tmp_path / "text.txt" / "x"), "/proc/self/fd/99/x", "/sys/x"]  # fmt: skip
    wrong = st.sampled_from(["walk", "Run", "", "-v", "--nothing", "runn", "run ", "--set", "RUN"])
    command = st.sampled_from(["run", "check", "plan", "chart", "stability"])
    extra = st.lists(st.sampled_from([*WORDS, *OPTIONS]), max_size=2)

    @examples(count)
    @given(st.one_of(
        st.tuples(wrong, st.sampled_from([str(good), *files])).map(list),
        st.tuples(command, st.sampled_from(files)).map(list),
        st.sampled_from(outs).map(lambda o: ["run", str(good), "--out", o]),
        command.map(lambda c: [c]),
        wrong.map(lambda c: [c]),
    ), extra)  # fmt: skip
    def one(words, more):
        asked = any(word in ("--help", "--version") for word in more)
        codes.append(judged([*words, *more], out))
        assert codes[-1] != 0 or asked, words

    one()
    assert len(codes) >= count
