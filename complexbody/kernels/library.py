# SPDX-License-Identifier: LGPL-3.0-or-later
"""One compiled library per kind of scene: its regions' kernels and the loops around them.

Per region a straight-line kernel is generated if the density is quadratic with coefficients
constant on each cell; any other density goes through FFCx. The library's source depends on
Hessians and sizes only, so scenes that differ in mesh or loads share it.
"""

from __future__ import annotations

import ctypes
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt
import ufl

from complexbody import _compat, hessian, native
from complexbody.action import Action
from complexbody.body import Body
from complexbody.discretisation import Discretisation
from complexbody.errors import SceneError
from complexbody.kernels import ffcx
from complexbody.kernels.quadratic import RegionSource

Array = npt.NDArray[np.float64]


class State(ctypes.Structure):
    """Mirror of ``state`` in driver.c."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in ("nodes", "interior", "chunks", "boundary_chunks")),
        ("step", ctypes.c_double),
        *(
            (name, ctypes.c_void_p)
            for name in (
                "table", "cell", "geometry", "coefficient", "x", "v", "f", "constant", "volume",
                "inverse_volume", "klass", "alpha", "beta", "eta", "sums", "coordinates", "counted",
                "forms", "activity", "plain",
            )
        ),
    )  # fmt: skip


class Densities:
    """What reading the bodies' densities found, region by region.

    Attributes:
        stored, potential: :class:`hessian.Quadratic` per region, or None where not quadratic
            (potential also where there is none).
        generated: True per region where straight-line code is generated.
        linear: True if all forces are affine in (u, ν).
        warnings: Null modes of semidefinite energies, in words.
    """

    def __init__(self, action: Action) -> None:
        scene = action.scene
        n_u, k, dim = scene.displacement, scene.descriptor, scene.mesh.geometry.dim
        self.stored: list[hessian.Quadratic | None] = []
        self.potential: list[hessian.Quadratic | None] = []
        self.generated: list[bool] = []
        self.linear = True
        for body in scene.bodies:
            action.stored_density(body, action.q)  # a clear error for a density that fails
            action.potential_density(body, action.q)
            e = hessian.read(body.energy, scene.mesh, n_u, k, "gradients")
            w = None
            if body.potential is not None:
                w = hessian.read(body.potential, scene.mesh, n_u, k, "fields")
            quadratic = e is not None and (body.potential is None or w is not None)
            self.linear &= quadratic
            self.stored.append(e)
            self.potential.append(w)
            cellwise = all(q is None or q.cellwise for q in (e, w))
            self.generated.append(quadratic and cellwise)
        self.coefficients: list[Any] = []
        for number, generated in enumerate(self.generated):
            for part in (self.stored[number], self.potential[number]):
                for expression in part.expressions() if generated and part else []:
                    if expression not in self.coefficients:
                        self.coefficients.append(expression)
        self._n, self._dim = (n_u, k), dim

    def total(self, number: int) -> dict[tuple[int, int], Any]:
        """H of ρe + ρw of a region by (row, column); floats, or indices into coefficients."""
        out: dict[tuple[int, int], list[Any]] = {}
        for part in (self.stored[number], self.potential[number]):
            for key, value in part.hessian.items() if part is not None else []:
                out.setdefault(key, []).append(value)
        return out


#: What was read, by action: a problem is laid out anew often, its densities stay.
_read: WeakKeyDictionary[Action, Densities] = WeakKeyDictionary()


class Kernels:
    """Forces and energies of a discretised scene, and the arrays they work on.

    Attributes:
        x, v, f: Node records (nodes + 1, NR): (u, ν), mean rates, forces. The last one is padding.
        state: What the C functions read.
        sums: Accumulated dissipated work, variations of u̇ and ν̇, work of loads, of supports.
    """

    def __init__(self, action: Action, disc: Discretisation) -> None:
        self.action, self.disc = action, disc
        if action not in _read:
            _read[action] = Densities(action)
        self.densities = _read[action]
        if action.scene.lumped and not all(self.densities.generated):
            raise SceneError(
                f"self_action={action.scene.self_action!r} needs quadratic energies with "
                "coefficients constant on each cell, and one of these is not. Use "
                "self_action='consistent'."
            )
        n, record = disc.n, disc.record
        shape = (disc.nodes + 1, record)
        self.x, self.v, self.f = (native.aligned(shape) for _ in range(3))
        self.sums = np.zeros(5)
        self.inverse_volume = 1.0 / disc.volume
        self.coefficients = self._coefficients()
        self.tabulated: list[dict[int, ffcx.Tabulated]] = []
        self._records = (ffcx.TabulatedRecord * (3 * len(action.scene.bodies)))()
        self._compile_tabulated()
        self.constant: Array | None = None
        self.state = State()
        s = self.state
        s.nodes, s.interior = disc.nodes, disc.late
        s.chunks, s.boundary_chunks = len(disc.chunks), disc.boundary_chunks
        for name, array in (
            ("table", disc.chunks), ("cell", disc.cells), ("geometry", disc.geometry),
            ("coefficient", self.coefficients), ("x", self.x), ("v", self.v), ("f", self.f),
            ("volume", disc.volume), ("inverse_volume", self.inverse_volume),
            ("sums", self.sums), ("coordinates", disc.position), ("counted", disc.owned),
        ):  # fmt: skip
            setattr(s, name, array.ctypes.data)
        # Libraries are shared by all scenes of one source: nothing of a scene may be kept in them.
        s.forms = ctypes.addressof(self._records)
        self.n, self.record = n, record
        self._libraries: dict[tuple[bool, bool, bool], ctypes.CDLL] = {}
        self.select(diagonal=True, damped=False)
        self._affine()

    def select(self, diagonal: bool, damped: bool, whole: bool = False) -> None:
        """Choose the variant of the node loop.

        Args:
            diagonal: Inertia and damping couple no components.
            damped: There is damping.
            whole: Components of u are coupled too, not only those of ν.
        """
        self._variant = (diagonal, damped, whole)

    @property
    def c(self) -> ctypes.CDLL:
        """The library of the chosen variant; compiled when first asked for."""
        key = self._variant
        if key not in self._libraries:
            library = native.load(self.source(*key))
            library.cb_power.restype = ctypes.c_double
            library.cb_quadratic.restype = ctypes.c_double
            library.cb_move.restype = ctypes.c_double
            library.cb_force_before.restype = ctypes.c_double
            self._libraries[key] = library
        return self._libraries[key]

    def source(self, diagonal: bool, damped: bool, whole: bool = False) -> str:
        """C source of the scene's library."""
        disc, scene = self.disc, self.action.scene
        d = self.densities
        defines = {
            "N": disc.n, "NU": scene.displacement, "NR": disc.record, "W": disc.lanes,
            "DIM": disc.dim, "GEOMETRY": disc.dim**2 + 1, "COEFFICIENTS": len(d.coefficients),
            "DIAGONAL": int(diagonal), "DAMPED": int(damped),
            "COUPLED": 0 if whole else scene.displacement,
        }  # fmt: skip
        parts = [f"#define {k} {v}" for k, v in defines.items()]
        files = ("vectors.h", "tabulated.h", "quiet.h")
        parts += [native.template(name) for name in files]
        force, energy, rest = [], [], []
        for r, generated in enumerate(d.generated):
            if generated:
                stored = d.stored[r]
                assert stored is not None
                lumped = scene.lumped
                region = RegionSource(
                    r, stored, d.potential[r], disc.n, disc.dim, lumped, d.coefficients
                )
                parts += [region.force(), region.energy()]
                force.append(f"case {r}: force_{r}(blocks, c, g, k, s->x, s->f); break;")
                energy.append(f"case {r}: energy_{r}(blocks, c, g, k, s->x, out); break;")
            else:
                common = "s->nodes, blocks, first, c, s->x, s->coordinates"
                force.append(
                    f"case {r}: tabulated_force(s->forms + {3 * r}, {common}, s->f); break;"
                )
                energy.append(
                    f"case {r}: tabulated_energy(s->forms + {3 * r + 1}, {common}, out);"
                    f" tabulated_energy(s->forms + {3 * r + 2}, {common}, out + 1); break;"
                )
                for i, what in ((0, "force"), (1, "energy"), (2, "energy")):
                    call = f"tabulated_rest(s->forms + {3 * r + i}, {common}, {what})"
                    rest.append(f"if (region == {r}) {call};")
        arguments = "region, blocks, first, c, g, k, s"
        parts.append(f"#define FORCE({arguments}) switch (region) {{ {' '.join(force)} }}")
        parts.append(f"#define ENERGY({arguments}, out) switch (region) {{ {' '.join(energy)} }}")
        head = "RESTLESS(region, blocks, first, c, s, force, energy)"
        parts.append(f"#define {head} {' '.join(rest)}")
        return "\n".join([*parts, native.template("driver.c"), native.template("books.c")])

    def _compile_tabulated(self) -> None:
        """Forms of regions without generated code: force, stored energy, potential energy."""
        action = self.action
        for r, body in enumerate(action.scene.bodies):
            forms: dict[int, ffcx.Tabulated] = {}
            if not self.densities.generated[r]:
                forms[0] = self._tabulated(body, 1)
                stored = lambda q, b=body: action.stored_density(b, q)  # noqa: E731
                forms[1] = ffcx.Tabulated(action, self.disc, stored, body.quadrature_degree, 0)
                if body.potential is not None:
                    outer = lambda q, b=body: action.potential_density(b, q)  # noqa: E731
                    forms[2] = ffcx.Tabulated(action, self.disc, outer, body.quadrature_degree, 0)
            for i, form in forms.items():
                self._records[3 * r + i] = form.record
            self.tabulated.append(forms)

    def second_derivative(self, number: int) -> ffcx.Tabulated:
        """FFCx's second derivative of the density of region ``number``, for any density."""
        return self._tabulated(self.action.scene.bodies[number], 2)

    def _tabulated(self, body: Body, rank: int) -> ffcx.Tabulated:
        def density(q: Any) -> Any:
            extra = self.action.potential_density(body, q)
            stored = self.action.stored_density(body, q)
            return stored if extra is None else stored + extra

        return ffcx.Tabulated(self.action, self.disc, density, body.quadrature_degree, rank)

    def _coefficients(self) -> Array:
        """Cell-wise coefficients of generated kernels, shape (blocks, coefficients, W)."""
        expressions = self.densities.coefficients
        if not expressions:
            return native.aligned((1, 1, self.disc.lanes))
        mesh = self.action.scene.mesh
        space = _compat.cell_space(mesh)
        owned = _compat.cell_count(mesh)[0]
        cells = np.arange(owned, dtype=np.int32)
        compiled = _compat.expression(ufl.as_vector(expressions), space)
        values = _compat.evaluate(compiled, mesh, cells)
        return self.disc.cell_values(values)

    def _affine(self) -> None:
        """The part of generated forces that does not depend on (u, ν), assembled by dolfinx."""
        from dolfinx import fem

        d, action = self.densities, self.action
        total: Any = 0
        for r, body in enumerate(action.scene.bodies):
            if not d.generated[r]:
                continue
            for part, density in (
                (d.stored[r], action.stored_density),
                (d.potential[r], action.potential_density),
            ):
                if part is not None and part.linear:
                    total += density(body, action.q) * action.measure(r)
        if isinstance(total, int):
            return
        action.q.x.array[:] = 0.0
        vector = np.zeros(len(action.q.x.array))
        fem.assemble_vector(vector, _compat.form(ufl.derivative(total, action.q, action.v)))
        self.constant = native.aligned(self.f.shape)
        self.constant[:-1, : self.n] = -self.disc.gather_sum(vector.reshape(-1, self.n))
        self.state.constant = self.constant.ctypes.data

    def reset_forces(self) -> None:
        """f = the constant part (or zero): what every evaluation adds to."""
        self.f[:] = 0.0 if self.constant is None else self.constant

    def forces(self) -> None:
        """f = −∂V/∂q at x: this rank's partial forces, without loads."""
        self.reset_forces()
        self.c.cb_forces(ctypes.byref(self.state))

    def energies(self, state: State | None = None) -> Array:
        """Stored and potential energy of this rank's cells by region, shape (regions, 2) [J].

        A run that tracks which cells are quiet gives its own ``state``.
        """
        out = np.zeros((len(self.action.scene.bodies), 2))
        self.c.cb_energies(ctypes.byref(state or self.state), native.pointer(out))
        return out

    def restless(self) -> tuple[npt.NDArray[np.bool_], bool]:
        """Chunks (chunks,) with forces at (u, ν) = 0, and whether any cell has an energy there.

        The constant part of generated forces, which is kept apart, does not count.
        """
        force, energy = np.zeros(len(self.disc.chunks), np.uint8), np.zeros(1, np.uint8)
        state, zero = State.from_buffer_copy(self.state), native.aligned(self.x.shape)
        state.x = zero.ctypes.data
        self.c.cb_restless(ctypes.byref(state), native.pointer(force), native.pointer(energy))
        d = self.densities
        generated = zip(d.generated, d.stored, d.potential, strict=True)
        parts = [p for made, *both in generated if made for p in both if p is not None]
        constant = any(not isinstance(p.constant, float) or p.constant != 0.0 for p in parts)
        return force > 0, bool(energy[0]) or constant

    def bytes_per_cell(self) -> float:
        """Memory of all arrays beside dolfinx's own mesh, per cell of this rank."""
        disc = self.disc
        arrays = [disc.cells, disc.geometry, disc.volume, disc.dof, disc.position, self.x, self.v]
        arrays += [self.f, self.inverse_volume, self.coefficients, disc.region, disc.source_cell]
        arrays += [disc.region_volume, disc.owned, disc.number]
        total = sum(a.nbytes for a in arrays if a is not None)
        return total / max(int(np.sum(disc.source_cell >= 0)), 1)
