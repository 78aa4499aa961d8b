# SPDX-License-Identifier: LGPL-3.0-or-later
"""What this installation is made of: versions, compiler, CPU, caches, and optional parts.

For result files and for ``complexbody info``. Knows no scene; asks each part, and never installs.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

import dolfinx
import numpy
from mpi4py import MPI
from petsc4py import PETSc

import complexbody
from complexbody import jitcache, native
from complexbody.errors import MissingPackage
from complexbody.rendering import require_vtk


def _distribution(*names: str) -> str:
    """Version of the first distribution that is there; apt's packages have other names."""
    for name in names:
        try:
            return importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return "unknown"


def versions() -> dict[str, str]:
    """Versions of complexbody and of what it computes with."""
    mpi = MPI.Get_library_version().split(",")[0].splitlines()[0].strip("\0 ")
    return {
        "complexbody": complexbody.__version__,
        "dolfinx": dolfinx.__version__,
        "ufl": _distribution("fenics-ufl"),
        "ffcx": _distribution("fenics-ffcx"),
        "petsc": ".".join(map(str, PETSc.Sys.getVersion())),
        "mpi": mpi,
        "numpy": numpy.__version__,
        "python": platform.python_version(),
    }


def commit() -> str | None:
    """Git commit of the complexbody that runs, with "+" if files differ from it; None without."""
    folder = Path(complexbody.__file__).parent

    def git(*command: str) -> str | None:
        try:
            done = subprocess.run(
                ["git", "-C", str(folder), *command],
                capture_output=True, text=True, check=False, env=dict(os.environ), timeout=10,
            )  # fmt: skip
        except (OSError, subprocess.TimeoutExpired):
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    # A virtual environment may lie in a repository that knows nothing of it.
    if git("ls-files", "--error-unmatch", "__init__.py") is None:
        return None
    head = git("rev-parse", "HEAD")
    changed = git("status", "--porcelain", "--untracked-files=no", "--", ".")
    return None if head is None else head + ("+" if changed else "")


def machine() -> dict[str, Any]:
    """The computer of this rank."""
    model = platform.processor() or platform.machine()
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                model = line.split(":", 1)[1].strip()
                break
    except OSError:
        pass
    return {
        "host": platform.node(),
        "system": platform.platform(),
        "cpu": model,
        "cores": len(os.sched_getaffinity(0)),
        "lanes": native.lanes(),
    }


#: Optional part, modules, how to install it, and what it is for.
_PARTS = (
    ("h5py", ("h5py",), "apt-get install python3-h5py", "fields for ParaView"),
    ("pyvista", ("pyvista", "vtkmodules"), "tools/setup.sh", "pictures"),
    ("SLEPc", ("slepc4py",), "apt-get install python3-slepc4py", "--critical global"),
    ("gmsh", ("gmsh",), "apt-get install python3-gmsh", "meshes of perforated plates"),
    ("tqdm", ("tqdm",), "tools/setup.sh", "progress on a terminal"),
)


def parts() -> list[tuple[str, bool, str]]:
    """Optional parts: name, whether it is there, and a version or how to install it.

    They are looked for, not imported: some change signal handlers. VTK is tried, elsewhere.
    """
    found: list[tuple[str, bool, str]] = []
    for name, modules, remedy, use in _PARTS:
        there = all(importlib.util.find_spec(module) for module in modules)
        version = _distribution(modules[0], name.lower()).replace("unknown", "there")
        found.append((name, there, f"{version if there else f'missing: {remedy}'} ({use})"))
    try:
        require_vtk()
    except MissingPackage as missing:
        return [*found, ("GL", False, f"missing: {missing}")]
    return [*found, ("GL", True, "VTK can draw (pictures of bodies in two and three dimensions)")]


def _folder(path: Path, pattern: str) -> str:
    files = list(path.glob(pattern)) if path.is_dir() else []
    size = sum(file.stat().st_size for file in files)
    return f"{path} ({len(files)} kernels, {size / 1e6:.1f} MB)"


def description() -> list[str]:
    """Everything above in lines, for ``complexbody info``."""
    here = machine()
    try:
        compiler = ", ".join(native.compiler())
    except MissingPackage as missing:
        compiler = f"missing: {missing}"
    entries = [
        *versions().items(),
        ("commit", commit() or "none (not run from a git repository)"),
        ("interpreter", sys.executable),
        ("compiler", compiler),
        ("cpu", f"{here['cpu']}, {here['cores']} cores, {here['lanes']} doubles per vector"),
        ("system", here["system"]),
        ("cache", _folder(native.cache_folder(), "kernel-*.so")),
        ("ffcx cache", _folder(jitcache.folder(), "libffcx_*.so")),
    ]
    lines = [f"{name:12s} {value}" for name, value in entries]
    lines += ["", "Optional parts:"]
    lines += [f"  {name:10s} {text}" for name, _, text in parts()]
    return lines
