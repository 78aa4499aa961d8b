# SPDX-License-Identifier: LGPL-3.0-or-later
"""What many tests need: meshes in general position, random bodies, forces by dolfinx, one verdict.

The reference forces are assembled by dolfinx from forms written here, on a space of u and another
one of ν. They share nothing with the package's own forms but the numbering of nodes.
"""

import re
import time
from contextlib import contextmanager

import dolfinx
import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import complexbody as cb
from complexbody import _compat
from complexbody.action import Action
from complexbody.discretisation import Discretisation
from complexbody.errors import ComplexBodyError
from complexbody.kernels.library import Kernels

PATIENCE = 30.0  # seconds that a rank waits for others which do not raise

_verdicts = MPI.COMM_WORLD.Dup()  # a rank that raised must not meet the messages of one that waits
_VERBS = (
    "Add|Change|Check|Choose|Contract|Give|Install|Interpolate|Let|Make|Move|Prescribe|Repair|Return|"
    "Sort|Tag|Use|Write"
)


@contextmanager
def refused(kind, *words):
    """Every rank raises ``kind`` itself, its message has all ``words`` and says what to do.

    Yields a list to which the message is appended.
    """
    caught, told = None, []
    try:
        yield told
    except Exception as error:
        caught = error
    everyone, deadline = _verdicts.Ibarrier(), time.monotonic() + PATIENCE
    while not everyone.Test():
        if time.monotonic() > deadline:
            pytest.fail(f"rank {_verdicts.rank} raised {caught!r}, and other ranks still wait")
        time.sleep(1e-3)
    if caught is not None and not isinstance(caught, ComplexBodyError):
        raise caught
    mine = (type(caught), str(caught))
    for rank, (found, message) in enumerate(_verdicts.allgather(mine)):
        assert found is kind, f"rank {rank}: {found.__name__}: {message}"
        for word in words:
            assert word in message, f"{word!r} is not in {message!r} (rank {rank})"
        assert re.search(rf"(^|[.:;,] |or )({_VERBS})\b", message, re.I), f"no advice: {message}"
    told.append(mine[1])


def everywhere(comm, truth):
    """True if ``truth`` holds on all ranks; collective."""
    return comm.allreduce(bool(truth), op=MPI.LAND)


def largest(comm, values):
    """Largest magnitude over all ranks; NaN counts as infinite; collective."""
    mine = np.abs(np.asarray(values, dtype=float))
    mine = np.where(np.isnan(mine), np.inf, mine)
    return comm.allreduce(float(np.max(mine, initial=0.0)), MPI.MAX)


def bent(comm, cells, ghosts=False):
    """A unit interval, square or cube of len(cells) dimensions, its vertices moved smoothly."""
    mode = getattr(dolfinx.mesh.GhostMode, "shared_facet" if ghosts else "none")
    corners = [np.zeros(len(cells)), np.ones(len(cells))]
    if len(cells) == 1:
        mesh = dolfinx.mesh.create_interval(comm, cells[0], [0.0, 1.0], ghost_mode=mode)
    elif len(cells) == 2:
        mesh = dolfinx.mesh.create_rectangle(comm, corners, list(cells), ghost_mode=mode)
    else:
        mesh = dolfinx.mesh.create_box(comm, corners, list(cells), ghost_mode=mode)
    _compat.equispaced(mesh)
    x = mesh.geometry.x
    moves = 0.04 * np.sin(7.3 * x @ [[1, 2, 1], [2, 1, 3], [1, 3, 2]] + [0.1, 0.5, 2])
    x[:, : len(cells)] += moves[:, : len(cells)]
    return mesh


def wavy(mesh, n, seed=0):
    """Values (geometry nodes, n) that depend on positions only, so not on the number of ranks."""
    rng = np.random.default_rng(seed)
    return np.sin(9 * mesh.geometry.x @ rng.normal(size=(3, n)) + rng.normal(size=n))


def vertex_rule(mesh):
    """The measure that takes values at vertices only."""
    rule = {"quadrature_rule": "vertex", "quadrature_degree": 1}
    if mesh.geometry.dim == 1 and hasattr(ufl, "VectorElement"):  # FFCx 0.5 fails on intervals
        points, weights = np.array([[0.0], [1.0]]), np.array([0.5, 0.5])
        rule = {"quadrature_rule": "custom", "quadrature_degree": 1}
        rule |= {"quadrature_points": points, "quadrature_weights": weights}
    return ufl.dx(domain=mesh, metadata=rule)


class Quadratic:
    """A random coercive energy ½ g·Hg, g = (U, ν, N) row by row; H = diag(d) + AᵀA is dense."""

    def __init__(self, n_u, k, seed=0, rank=3):
        rng = np.random.default_rng(seed)
        self.n_u, self.k, m = n_u, k, 3 * n_u + 4 * k
        self.diagonal = rng.uniform(0.5, 2.0, m)
        self.factor = rng.normal(size=(rank, m)) / 2
        self.hessian = np.diag(self.diagonal) + self.factor.T @ self.factor
        self.values = np.zeros(m, bool)
        self.values[3 * n_u : 3 * n_u + k] = True

    @staticmethod
    def unknowns(U, nu, N):
        """All entries, as a list."""
        parts = [U[i] for i in np.ndindex(U.ufl_shape)] + [nu[i] for i in np.ndindex(nu.ufl_shape)]
        return parts + [N[i] for i in np.ndindex(N.ufl_shape)]

    def energy(self, U, nu, N):
        """½ g·Hg written out, row by row."""
        g, H = self.unknowns(U, nu, N), self.hessian
        rows = [sum(H[i, j] * g[j] for j in range(len(g)) if H[i, j]) for i in range(len(g))]
        return 0.5 * sum(g[i] * row for i, row in enumerate(rows))

    def constants(self, mesh):
        """The numbers of :meth:`form`, which is compiled once for all of them."""
        return fem.Constant(mesh, self.diagonal), fem.Constant(mesh, self.factor)

    def form(self, constants, U, nu, N, self_action=None):
        """Its integral, with the constants apart and the self-action by another measure."""
        g, (d, A) = self.unknowns(U, nu, N), constants
        if self_action is None:
            return self._factored(d, A, g, range(len(g))) * ufl.dx
        own = self._factored(d, A, g, np.flatnonzero(self.values))
        return (self._factored(d, A, g, range(len(g))) - own) * ufl.dx + own * self_action

    def _factored(self, d, A, g, chosen):
        squares = [sum(A[r, int(i)] * g[i] for i in chosen) ** 2 for r in range(len(self.factor))]
        return 0.5 * (sum(squares) + sum(d[int(i)] * g[i] ** 2 for i in chosen))


class Reference:
    """Forces and energies of ∫ of a density by dolfinx, on a space of u and one of ν."""

    def __init__(self, mesh, n_u, k):
        self.mesh, self.n_u, self.k = mesh, n_u, k
        self.u = fem.Function(_compat.vector_space(mesh, n_u))
        self.nu = fem.Function(_compat.vector_space(mesh, k))
        self.U, self.N = self._gradient(self.u, n_u), self._gradient(self.nu, k)

    def _gradient(self, function, rows):
        gradient, dim = ufl.grad(function), self.mesh.geometry.dim
        zero = ufl.as_ufl(0.0)
        return ufl.as_tensor(
            [[gradient[i, j] if j < dim else zero for j in range(3)] for i in range(rows)]
        )

    def set(self, values):
        """Set (u, ν) from values (geometry nodes, n_u + k)."""
        self.u.x.array[:] = values[:, : self.n_u].ravel()
        self.nu.x.array[:] = values[:, self.n_u :].ravel()

    @staticmethod
    def _by_rule(form):
        """The form in parts of one quadrature rule each: FFCx 0.5 mixes up tables of several."""
        rules = {}
        for integral in form.integrals():
            rule = integral.metadata().get("quadrature_rule", "default")
            rules.setdefault(rule, []).append(integral)
        return [ufl.Form(integrals) for integrals in rules.values()]

    def energy(self, form):
        """The integral over the body; collective."""
        local = sum(fem.assemble_scalar(_compat.form(part)) for part in self._by_rule(form))
        return self.mesh.comm.allreduce(local)

    def forces(self, form):
        """−∂form/∂(u, ν) at all nodes, shape (geometry nodes, n_u + k); collective."""
        out = []
        for field, count in ((self.u, self.n_u), (self.nu, self.k)):
            space, forces = field.function_space, fem.Function(field.function_space)
            for part in self._by_rule(form):
                residual = ufl.derivative(part, field, ufl.TestFunction(space))
                if not ufl.algorithms.expand_derivatives(residual).empty():
                    fem.assemble_vector(forces.x.array, _compat.form(residual))
            _compat.accumulate(forces)
            out.append(-forces.x.array.reshape(-1, count))
        return np.concatenate(out, axis=1)


class Machine:
    """A scene's kernels, fed and read by geometry nodes."""

    def __init__(self, mesh, body, **scene):
        self.scene = cb.Scene(mesh, body, **scene)
        self.action = Action(self.scene)
        self.disc = Discretisation(self.scene)
        self.kernels = Kernels(self.action, self.disc)

    def set(self, values):
        """Set (u, ν) from values (geometry nodes, n)."""
        self.kernels.x[:] = 0.0
        self.kernels.x[:-1, : self.disc.n] = self.disc.gather(values)

    def forces(self):
        """Forces at this rank's nodes, summed over ranks, shape (nodes, n); collective."""
        self.kernels.forces()
        forces = self.kernels.f[:-1].copy()
        self.disc.sum_shared(forces)
        assert not forces[:, self.disc.n :].any(), "a padding component has a force"
        return forces[:, : self.disc.n]

    def energies(self):
        """Stored and potential energies by region over all ranks, shape (regions, 2)."""
        return self.disc.comm.allreduce(self.kernels.energies())

    def total(self, values):
        """Sum over the nodes of the whole body of values (nodes, m); collective."""
        return self.disc.comm.allreduce(values[self.disc.owned].sum(axis=0))

    def close(self):
        """Free the communicator."""
        self.disc.halo.close()
