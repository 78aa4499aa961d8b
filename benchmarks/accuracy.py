# SPDX-License-Identifier: LGPL-3.0-or-later
"""An accuracy asked for: is it met, at which cost, and what do the pilot runs take?

    python benchmarks/accuracy.py [--scenes bar notch plate phason] [--repeats 3]

The scenes of the charts, at sizes of minutes. Each request is run by ``simulate(accuracy=…)``; the
method and step that it chose are then measured as a chart measures a point, beside a chart of our
own methods at four steps. Printed: the true error over the request, *total* against the exact
solution where there is one, else *in time* against the semi-discrete reference, over what the mesh
leaves of the request; the estimates over the true ones; processor time over that of the cheapest
charted point that meets the same; updates and time of the pilot runs over the run's.
"""

from __future__ import annotations

import argparse
import importlib.util
import warnings
from pathlib import Path
from typing import Any

from mpi4py import MPI

import complexbody as cb
from complexbody.contenders import Contender
from complexbody.errors import AccuracyError

HERE = Path(__file__).parent / "scenes"
METHODS = ("synchronous", "avi", "avi-windows", "local-leapfrog")
#: Scene, its parameters, requests.
CASES: dict[str, list[tuple[dict[str, Any], tuple[float, ...]]]] = {
    "bar": [({"cells": 100}, (1e-2, 3e-3)), ({"cells": 400}, (1e-2, 1e-3))],
    "phason": [({"cells": 40}, (2e-2, 1e-2)), ({"cells": 80}, (1e-2, 3e-3))],
    "notch": [({"refine": 0.5}, (5e-2, 3e-2)), ({"refine": 0.8}, (2e-2, 1e-2, 3e-3))],
    "plate": [({"refine": 0.3}, (1e-1, 5e-2)), ({"refine": 0.6}, (2e-2,))],
}


def read(name: str) -> Any:
    """The scene file as a module."""
    spec = importlib.util.spec_from_file_location(name, HERE / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def rows_of(scene: cb.Scene, until: float, exact: Any, repeats: int, **more: Any) -> list[Any]:
    """Rows of a chart that ran to the end."""
    made = cb.chart(scene, until=until, exact=exact, repeats=repeats, **more)
    return [row for row in made.rows if row["status"] == "done"]


def measure(name: str, values: dict[str, Any], asked: tuple[float, ...], repeats: int) -> None:
    """Print a line per request."""
    module = read(name)
    until, exact = module.DEFAULTS["until"], getattr(module, "exact", None)
    scene = module.scene(MPI.COMM_SELF, **values)
    charted: list[Any] = []
    kind = "total" if exact else "time"
    for request in asked:
        label = f"{name} {', '.join(f'{k}={v}' for k, v in values.items())}, asked {request:g}"
        try:
            told = cb.simulate(scene, until=until, accuracy=request).accuracy
        except AccuracyError as error:
            print(f"{label}: refused: {str(error).split('. ')[0]}", flush=True)
            continue
        charted = charted or rows_of(scene, until, exact, repeats, methods=METHODS)
        one = Contender("chosen", "chosen", lambda factor, step, m=told.method: m)
        (row,) = rows_of(scene, until, exact, repeats, methods=[one], steps=[1.0])
        bound = request if exact else request - told.mesh
        found, time = row[f"{kind}_error"]["fields"], row["time_error"]["fields"]
        fit = [r["seconds"] for r in charted if r[f"{kind}_error"]["fields"] <= bound]
        over = row["seconds"] / min(fit) if fit else float("nan")
        print(
            f"{label}: {type(told.method).__name__} at {told.factor:.2f}; {kind} error over "
            f"request {found / bound:.2g}; time estimated over true {told.verified / time:.2g}, "
            f"mesh estimated {told.mesh:.2g}; cost over best charted {over:.2g}; pilots "
            f"{told.updates:.2g} of updates, {told.share:.2g} of time; "
            f"{told.restarts} restarts", flush=True,
        )  # fmt: skip


def main() -> None:
    """All scenes asked for."""
    style = argparse.RawTextHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=style)
    parser.add_argument("--scenes", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    warnings.simplefilter("ignore", UserWarning)
    for name in options.scenes:
        for values, asked in CASES[name]:
            measure(name, values, asked, options.repeats)


if __name__ == "__main__":
    main()
