# SPDX-License-Identifier: LGPL-3.0-or-later
"""``complexbody plan``: what a scene needs, before it runs."""

from __future__ import annotations

import argparse
from typing import Any

from complexbody import report
from complexbody.commands import job_of
from complexbody.planning import plan
from complexbody.together import say, together

TEXT = (
    "say what a scene needs and what it does not: components that move, kernels, dissipation, "
    "steps, times of its fields; what run leaves out, and what it would rather ask about"
)


def command(a: argparse.Namespace, ranks: Any) -> None:
    """Read the scene file, plan it and print the table; collective."""
    job = job_of(a, ranks)
    with together(ranks):
        made = plan(job.scene, job.until, job.method)
    say(ranks, report.heading(job.file.path, job.scene, job.parameters), str(made))
