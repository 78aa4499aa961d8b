# SPDX-License-Identifier: LGPL-3.0-or-later
"""Planes of symmetry: half a body moves as the whole one does, and what is no mirror is refused."""

import dolfinx
import numpy as np
import pytest
import ufl
from harness import largest, refused
from mpi4py import MPI

import complexbody as cb
from complexbody import _compat
from complexbody.errors import SceneError
from complexbody.forms import decagonal_quasicrystal, isotropic_two_field
from complexbody.mirrors import representation, sampled
from complexbody.problem import Problem

COMM = MPI.COMM_WORLD


def cosserat():
    """A plane Cosserat body: u in the plane and one rotation about z, an axial vector."""

    def energy(U, phi, N):
        e = ufl.sym(ufl.as_tensor([[U[i, j] for j in range(2)] for i in range(2)]))
        turn = 0.5 * (U[1, 0] - U[0, 1]) - phi[0]
        return 0.6 * ufl.tr(e) ** 2 + ufl.inner(e, e) + 0.7 * turn**2 + 0.2 * ufl.inner(N, N)

    return cb.Body(1, energy, 1.0, 0.4, displacement=2, parity="axial", name="Cosserat")


def mirrored(half):
    """The square [−1, 1]×[0, 1], of which the part x > 0, if only ``half``; mirror images."""
    n = 4
    x, y = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, n + 1), indexing="ij")
    moves = 0.03 * np.sin(5 * x + 3 * y) * np.sin(np.pi * x) * np.sin(np.pi * y)
    right = np.stack([x + moves, y - moves], axis=-1).reshape(-1, 2)
    corner = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    a, b, c, d = corner, corner + n + 1, corner + n + 2, corner + 1
    cells = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    points = right
    if not half:
        points = np.concatenate([right, right * [-1.0, 1.0]])
        image = cells + len(right)
        on_plane = np.arange(n + 1)  # of which there is one
        image = np.where(image - len(right) <= n, image - len(right), image)
        assert np.all(right[on_plane, 0] == 0)
        cells = np.concatenate([cells, image])
        used = np.setdiff1d(np.arange(len(points)), on_plane + len(right))
        number = np.full(len(points), -1)
        number[used] = np.arange(len(used))
        points, cells = points[used], number[cells]
    if COMM.rank:
        points, cells = points[:0], cells[:0]
    return _compat.create_mesh(COMM, cells.astype(np.int64), np.ascontiguousarray(points))


def start(body, sign_nu):
    """Initial rates that are the same in the mirror x → −x; components of ν have these signs."""

    def even(x, phase):
        return np.cos(3 * x[0]) * np.cos(2 * x[1] + phase)

    def odd(x, phase):
        return np.sin(2 * x[0]) * np.cos(3 * x[1] + phase)

    def nu_dot(x):
        return np.array([(even if s > 0 else odd)(x, i) for i, s in enumerate(sign_nu)])

    return cb.Initial(u_dot=lambda x: np.array([odd(x, 0.3), even(x, 0.7)]), nu_dot=nu_dot)


def fields(scene):
    """{position: (u, ν)} of a run's nodes on this rank."""
    method = cb.Synchronous(step=0.02, unstable_ok=True)
    result = cb.simulate(scene, method, until=1.0, progress=False)
    parts = [f.x.array.reshape(-1, f.function_space.dofmap.bs) for f in (result.u, result.nu)]
    values, x = np.concatenate(parts, axis=1), scene.mesh.geometry.x
    every = {tuple(np.round(p, 9) + 0.0): v for p, v in zip(x, values, strict=True)}
    return {k: v for part in COMM.allgather(every) for k, v in part.items()}


@pytest.mark.parametrize(
    "body, signs, parity",
    [(isotropic_two_field(d=2, viscosity=0.3), (-1, 1), None), (cosserat(), (-1,), None),
     (cosserat(), (-1,), [[-1.0]])],
    ids=["polar", "axial", "matrix"],
)  # fmt: skip
def test_half_a_body_moves_as_the_whole_on_all_ranks(body, signs, parity):
    whole = cb.Scene(mirrored(half=False), body, initial=start(body, signs))
    plane = cb.Symmetry(where=lambda x: x[0] < 1e-9, parity=parity)
    half = cb.Scene(mirrored(half=True), body, supports=[plane], initial=start(body, signs))
    one, two = fields(whole), fields(half)
    assert len(two) == 25 and len(one) == 45
    size = max(np.abs(v).max() for v in one.values())
    assert size > 0.05
    assert max(np.abs(one[k] - v).max() for k, v in two.items()) < 1e-12 * max(size, 1.0)


@pytest.mark.serial
def test_three_dimensions_and_forms():
    box = dolfinx.mesh.create_unit_cube(MPI.COMM_SELF, 1, 1, 1)
    for axis in range(3):
        plane = cb.Symmetry(where=lambda x, a=axis: x[a] < 1e-9, normal=np.eye(3)[axis])
        problem = Problem(cb.Scene(box, isotropic_two_field(), supports=[plane]))
        held = problem.supports.fixed[np.abs(box.geometry.x[:, axis]) < 1e-9]
        expected = np.tile(np.arange(3) == axis, 2)
        assert np.array_equal(held, np.tile(expected, (4, 1)))
    square = dolfinx.mesh.create_unit_square(MPI.COMM_SELF, 1, 1)
    Problem(cb.Scene(square, decagonal_quasicrystal(),
                     supports=[cb.Symmetry(where=lambda x: x[0] < 1e-9)]))  # fmt: skip


@pytest.mark.serial
def test_representations():
    Q = np.diag([-1.0, 1.0, 1.0])
    assert np.array_equal(np.diag(representation("axial", Q, 3, "ν")), [1, -1, -1])
    tensor = representation("tensor", Q, 9, "ν")
    rng = np.random.default_rng(0)
    t = rng.normal(size=(3, 3))
    assert np.allclose(tensor @ t.ravel(), (Q @ t @ Q.T).ravel())
    assert np.array_equal(representation("odd", Q, 2, "ν"), -np.eye(2))


def test_what_is_no_mirror_is_refused_on_all_ranks():
    mesh, body = mirrored(half=True), cosserat()

    def left(x):
        return x[0] < 1e-9

    def scene(body=body, where=left, **options):
        return cb.Scene(mesh, body, supports=[cb.Symmetry(where, **options)])

    def run(scene):
        cb.simulate(scene, until=0.1, progress=False)

    with refused(SceneError, "energy of Cosserat", "changes by"):
        run(scene(parity="even"))
    with refused(SceneError, "not all perpendicular"):
        run(scene(where="boundary"))
    with refused(SceneError, "normal", "perpendicular to x"):
        run(scene(normal=(0.0, 1.0)))
    with refused(SceneError, "several planes"):
        run(scene(where=lambda x: (x[0] < 1e-9) | (x[0] > 1 - 1e-9)))
    with refused(SceneError, "selects no"):
        run(scene(where=lambda x: x[0] > 2))
    with refused(SceneError, "no parity"):
        run(scene(parity="tensors"))
    unknown = cb.Body(2, lambda U, v, N: ufl.inner(U, U) + ufl.inner(N, N), 1.0, 1.0)
    with refused(SceneError, "not known"):
        run(scene(body=unknown))
    with refused(SceneError, "mixes components of ν"):
        run(scene(body=unknown, parity=[[0.0, 1.0], [1.0, 0.0]]))
    skew = cb.Body(
        2, lambda U, v, N: ufl.inner(U, U) + ufl.inner(N, N), 1.0, [[1.0, 0.5], [0.5, 1.0]]
    )
    with refused(SceneError, "inertia"):
        run(scene(body=skew, parity="polar"))
    bent = cb.Body(
        1, lambda U, v, N: ufl.inner(U, U) + ufl.inner(N, N), 1.0, 1.0,
        potential=lambda u, v: ufl.exp(v[0]) + v[0] ** 2,
    )  # fmt: skip
    with refused(SceneError, "potential"):
        run(scene(body=bent, parity="odd"))


def test_nonlinear_energies_are_sampled_on_all_ranks():
    def energy(U, v, N):
        return ufl.inner(U, U) + ufl.inner(N, N) + ufl.exp(v[0] ** 2) + 0.1 * v[0] ** 2 * U[0, 0]

    def worse(U, v, N):
        return energy(U, v, N) + 0.1 * v[0] ** 3

    mesh, Q = mirrored(half=True), np.diag([-1.0, 1.0, 1.0])
    for density, low, high in ((energy, 0.0, 1e-14), (worse, 1e-6, 1.0)):
        scene = cb.Scene(mesh, cb.Body(1, density, 1.0, 1.0, displacement=2))
        change = largest(COMM, sampled(scene, 0, "energy", Q, Q[:2, :2], -np.eye(1)))
        assert low <= change <= high
