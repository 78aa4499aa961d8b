# SPDX-License-Identifier: LGPL-3.0-or-later
"""What the folder of a run says about how it was started, for those who go on with it."""

from __future__ import annotations

import json
from pathlib import Path

from complexbody.errors import CheckpointError


def recorded_words(folder: Path) -> tuple[list[str], str]:
    """The words of the command line that a folder's run was started with, and its scene file.

    Raises:
        CheckpointError: if the folder has no run of the command line.
    """
    path = folder / "run.json"
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        words, file = [str(word) for word in values["words"]], str(values["file"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(
            f"{folder} has no run to resume: {path} cannot be read ({error}). Give the folder of a "
            "run of the command line, or use cb.simulate(…, resume=…)."
        ) from error
    return words, file
