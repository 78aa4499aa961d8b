# SPDX-License-Identifier: LGPL-3.0-or-later
"""A line on rank 0's terminal while a run goes on: time, steps, time left."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any


class Progress:
    """Progress towards ``until`` [s]; silent on other ranks and where nobody watches.

    Args:
        comm: The run's communicator.
        until: End of the run.
        wanted: True or False; None shows it where standard error is a terminal.
    """

    def __init__(self, comm: Any, until: float, wanted: bool | None) -> None:
        show = sys.stderr.isatty() if wanted is None else wanted
        self._bar: Any = None
        if comm.rank == 0 and show:
            from tqdm import tqdm

            form = "{l_bar}{bar}| t = {n:.4g}/{total:.4g} s [{elapsed}<{remaining}]{postfix}"
            self._bar = tqdm(total=until, bar_format=form, mininterval=0.5)

    def update(self, time: float, steps: int) -> None:
        """Show that ``time`` is reached after ``steps`` steps."""
        if self._bar is not None:
            self._bar.set_postfix_str(f"{steps} steps", refresh=False)
            self._bar.update(min(time, self._bar.total) - self._bar.n)

    def close(self) -> None:
        """Leave the line: what follows starts on a new one."""
        if self._bar is not None:
            self._bar.close()


def counted(items: Sequence[Any], name: str, wanted: bool | None) -> Any:
    """The items, one by one, with a line that counts them; for one process.

    Args:
        items: What is gone through.
        name: What to call them.
        wanted: True or False; None shows it where standard error is a terminal.
    """
    if not (sys.stderr.isatty() if wanted is None else wanted):
        return items
    from tqdm import tqdm

    return tqdm(items, desc=name, mininterval=0.5, leave=False)
