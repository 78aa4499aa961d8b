# SPDX-License-Identifier: LGPL-3.0-or-later
"""χ by the vertex rule: momenta and rates node by node, by a compiled k×k Newton (implicit.c)."""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from complexbody import native
from complexbody.kinetics import NodalKinetics

if TYPE_CHECKING:
    from complexbody.integrators.implicit_run import ImplicitRun

Array = npt.NDArray[np.float64]

#: Why a node has no solution, by the number that implicit.c gives.
REASONS = (
    "",
    "its equation has values that are not finite",
    "the step is beyond T₀ there: the equation for the rates need not have one solution",
    "the kinetic co-energy is not convex in ν̇ there (A5)",
    "its Jacobian is singular",
    "Newton does not converge",
)


def layout(k: int) -> tuple[type[ctypes.Structure], type[ctypes.Structure]]:
    """Mirrors of ``material`` and ``implicit`` in implicit.c for k components of ν."""
    i64, pointer, real = ctypes.c_int64, ctypes.c_void_p, ctypes.c_double

    class Material(ctypes.Structure):
        _fields_ = (
            ("chi", pointer), ("constants", pointer), ("at_nu", i64), ("at_rate", i64),
            ("omega", real * (k * k)), ("eta", real * (k * k)),
        )  # fmt: skip

    class State(ctypes.Structure):
        _fields_ = (
            *((name, i64) for name in ("nodes", "most", "unstable_ok", "ranges")),
            *((name, real) for name in ("h", "s", "tolerance")),
            *(
                (name, pointer)
                for name in (
                    "x", "v", "f", "previous", "next", "momentum", "after", "reaction", "volume",
                    "density", "fixed", "counted", "start", "region", "share", "materials",
                    "position", "sums", "count", "activity", "ends",
                )
            ),
        )  # fmt: skip

    return Material, State


class NodalNewton:
    """The nodes' equations of an implicit run; what :class:`ImplicitRun` asks of a solver.

    Args:
        run: The run, whose arrays it works on.
    """

    def __init__(self, run: ImplicitRun) -> None:
        problem, disc = run.problem, run.problem.disc
        self.run, k = run, problem.scene.descriptor
        defines = {"N": disc.n, "NU": disc.n - k, "NR": disc.record, "K": k}
        source = [f"#define {name} {value}" for name, value in defines.items()]
        source += [native.template(name) for name in ("quiet.h", "implicit.c")]
        self.c = native.load("\n".join(source))
        for name in ("im_solve", "im_rates"):
            getattr(self.c, name).restype = ctypes.c_int64
        self.c.im_kinetic.restype = ctypes.c_double
        Material, State = layout(k)
        self._materials = (Material * len(problem.inertias))()
        self._keep = []
        for material, body in zip(self._materials, problem.inertias, strict=True):
            material.eta[:] = body.viscosity_matrix.ravel()
            if not callable(body.inertia):
                material.omega[:] = body.inertia_matrix.ravel()
                continue
            chi = NodalKinetics(body, problem.scene.mesh)
            material.chi, material.constants = chi.function, chi.constants.ctypes.data
            material.at_nu, material.at_rate = chi.at_nu, chi.at_rate
            self._keep.append(chi)
        node, region = np.nonzero(disc.region_volume > 0)
        masses = problem.masses
        klass = masses.classes[:-1]
        arrays = {
            "start": np.searchsorted(node, np.arange(disc.nodes + 1)).astype(np.int64),
            "region": region.astype(np.int32),
            "share": disc.region_volume[node, region],
            "density": masses.density[klass],
            "fixed": masses.fixed[klass].astype(np.uint8),
            "volume": disc.volume, "counted": disc.owned, "position": disc.position,
            "count": run.count, "sums": problem.kernels.sums, "x": problem.kernels.x,
            "v": problem.kernels.v, "f": problem.kernels.f, "previous": run.previous,
            "next": run.next, "momentum": run.momentum, "after": run.after, "ends": run.ranges(),
        }  # fmt: skip
        self.state = State()
        for name, array in arrays.items():
            arrays[name] = np.ascontiguousarray(array)
            setattr(self.state, name, arrays[name].ctypes.data)
        self._arrays = arrays
        s = self.state
        s.reaction = run.reaction.ctypes.data if run.reaction is not None else None
        s.materials = ctypes.addressof(self._materials)
        s.nodes, s.most, s.unstable_ok = (
            disc.nodes, run.method.iterations, run.method.unstable_ok,
        )  # fmt: skip
        s.ranges = len(run.ranges())
        s.h, s.s, s.tolerance = run.step, run.s, run.method.tolerance
        self._node, self._iterations = ctypes.c_int64(-1), ctypes.c_int64(0)

    def solve(self) -> tuple[str, int]:
        """Next rates into ``run.next``; why it failed, in words, and at which node ("", −1)."""
        return self._told(
            self.c.im_solve(
                ctypes.byref(self.state), ctypes.byref(self._node), ctypes.byref(self._iterations)
            )
        )

    def restless(self) -> npt.NDArray[np.bool_]:
        """Nodes where rest does not solve the equation: ∂χ/∂ν̇ or ∂χ/∂ν is not 0 at (0, 0)."""
        flags = np.zeros(self.run.problem.disc.nodes, np.uint8)
        self.c.im_restless(ctypes.byref(self.state), native.pointer(flags))
        return flags > 0

    def commit(self) -> None:
        """Take the step that was solved for, and book it.

        Nodes at rest are solved for in the first step, like all others: what is wrong there shows.
        """
        self.c.im_commit(ctypes.byref(self.state))
        self.follow()

    def follow(self) -> None:
        """Skip nodes that the run's activity calls quiet, from now on."""
        activity = self.run.activity
        self.state.activity = None if activity is None else ctypes.addressof(activity.state)

    def momenta(self, rates: Array, out: Array) -> None:
        """∂χ/∂ν̇ at (ν, rates) integrated over each node's volume, shape (nodes, k)."""
        self.c.im_momentum(
            ctypes.byref(self.state), native.pointer(rates), native.pointer(out)
        )  # fmt: skip

    def rates(self, momentum: Array, rates: Array) -> tuple[str, int]:
        """Rates of given momenta at this time, from the guess in ``rates``; as :meth:`solve`."""
        return self._told(
            self.c.im_rates(
                ctypes.byref(self.state), native.pointer(momentum), native.pointer(rates),
                ctypes.byref(self._node), ctypes.byref(self._iterations),
            )
        )  # fmt: skip

    def kinetic(self, rates: Array) -> float:
        """∫∂χ/∂ν̇·ν̇ − χ of this rank [J]."""
        return float(self.c.im_kinetic(ctypes.byref(self.state), native.pointer(rates)))

    def _told(self, reason: int) -> tuple[str, int]:
        return (REASONS[reason], int(self._node.value)) if reason else ("", -1)

    def close(self) -> None:
        """Nothing to free."""
