# SPDX-License-Identifier: LGPL-3.0-or-later
"""The programs in the documentation run as they stand, and its links lead somewhere."""

import doctest
import re
from pathlib import Path

import pytest

from complexbody import cli

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)")
COMMAND = re.compile(r"^    (?:mpirun .+ )?\.venv/bin/complexbody (.+?)(?:\s+#.*)?$", re.MULTILINE)

pytestmark = pytest.mark.serial


def _blocks(page):
    return BLOCK.findall(page.read_text())


@pytest.mark.parametrize("page", [p for p in PAGES if _blocks(p)], ids=lambda p: p.stem)
def test_programs_run(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = {"__name__": page.stem}
    for number, block in enumerate(_blocks(page)):
        saved = re.match(r"# file: (\S+)\n", block)
        if saved:  # a file that the reader is told to write
            Path(saved[1]).write_text(block)
        elif ">>>" in block:
            test = doctest.DocTestParser().get_doctest(block, names, page.name, str(page), number)
            assert doctest.DocTestRunner().run(test, clear_globs=False).failed == 0
            names.update(test.globs)
        else:
            exec(compile(block, f"{page}, block {number}", "exec"), names)


def test_the_tutorials_scene_file_runs(tmp_path, monkeypatch):
    """What it tells the reader to type, on a coarse mesh."""
    monkeypatch.chdir(tmp_path)
    (source,) = (b for b in _blocks(ROOT / "docs/tutorial.md") if b.startswith("# file:"))
    Path("cracks.py").write_text(source)
    assert cli.main(["check", "cracks.py", "--set", "cells=4"]) == 0
    assert cli.main(["run", "cracks.py", "--set", "cells=4", "--until", "0.2"]) == 0
    assert (tmp_path / "results/cracks/u.xdmf").exists()


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_links_lead_somewhere(page):
    for target in LINK.findall(page.read_text()):
        assert (page.parent / target).exists(), f"{page.name}: {target}"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_commands_are_known(page):
    parser = cli.parser()
    for line in COMMAND.findall(page.read_text()):
        parser.parse_args([word for word in line.split() if word not in ("…", "...")])
