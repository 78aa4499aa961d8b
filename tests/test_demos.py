# SPDX-License-Identifier: LGPL-3.0-or-later
"""Every demo runs at a small size, on all ranks, and passes the check it ends in."""

import json
from pathlib import Path

import pytest

from complexbody.cli import main

DEMOS = Path(__file__).parents[1] / "demos"

#: Demo, parameters that make it small, and a phrase its check must say.
SMALL = [
    ("standing_wave.py", ("--set", "cells=32"), "error"),
    ("standing_wave.py", ("--set", "cells=32", "--set", "dim=1"), "error"),
    ("bubbly_shock.py", ("--set", "cells=550"), "phase speeds"),
    (
        "impact.py",
        ("--set", "refine=0.5", "--until", "2.4e-6", "--every", "1.2e-6"),
        "first pulse at",
    ),
    (
        "graded_crack.py",
        ("--set", "refine=0.3", "--set", "grading=75", "--until", "0.6"),
        "local leapfrog",
    ),
    (
        "graded_crack.py",
        ("--set", "dim=3", "--set", "refine=0.2", "--set", "grading=75", "--until", "0.5"),
        "local leapfrog",
    ),
    ("decagonal_waves.py", ("--set", "cells=120"), "of dispersion"),
    ("cosserat_beam.py", ("--set", "layers=6", "--until", "1e-4"), "of the formula"),
    ("band_gap.py", ("--set", "cells=2400"), "in the gap q within"),
    ("microcracked_plate.py", ("--set", "cells=80"), "of dispersion"),
    ("nematic.py", ("--set", "cells=24"), "tilt grows at"),
    ("your_own_body.py", ("--set", "cells=600", "--until", "10"), "kinks have run"),
]


@pytest.mark.parametrize(("demo", "options", "told"), SMALL)
def test_demo(demo, options, told, comm, shared_path):
    out = shared_path / "results"
    assert main(["run", str(DEMOS / demo), *options, "--out", str(out), "--quiet"]) == 0
    if comm.rank == 0:
        run = json.loads((out / "run.json").read_text())
        assert run["state"] == "finished"
        assert told in run["check"]
        assert (out / "ledger.csv").stat().st_size > 0
        assert list(out.glob("*.xdmf"))


def test_every_demo_is_here():
    assert {path.name for path in DEMOS.glob("[!_]*.py")} == {name for name, *_ in SMALL}
