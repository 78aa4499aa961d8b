"""Largest eigenvalues of the cells' lumped pencils, against numpy.linalg.eigvalsh."""

import numpy as np
import pytest

from complexbody.kernels import pencil

LANES = [4, 8]


def simplices(rng, cells, dim):
    """Shape gradients B_a (a = 1 … d) and volumes of random simplices, slivers among them."""
    edges = rng.normal(size=(cells, dim, dim)) + 2.0 * np.eye(dim)
    edges[::5, -1] = edges[::5, 0] * (dim > 1) + 1e-3 * edges[::5, -1]
    edges[1::5] *= 1e-4
    volume = np.abs(np.linalg.det(edges)) / np.prod(np.arange(1, dim + 1))
    return np.linalg.inv(edges).transpose(0, 2, 1), volume


def blocked(values, lanes):
    """Arrays by cell (cells, …) as (blocks, …, lanes), padded with zeros."""
    blocks = -(-len(values) // lanes)
    whole = np.zeros((blocks * lanes, *values.shape[1:]))
    whole[: len(values)] = values
    return np.ascontiguousarray(np.moveaxis(whole.reshape(blocks, lanes, -1), 1, 2))


def geometry(gradients, volume, lanes):
    root = np.sqrt(volume)[:, None]
    return blocked(np.hstack([gradients.reshape(len(volume), -1) * root, root]), lanes)


def coercive(rng, n, dim, cells=1, values=True):
    """Random Hessians (cells, 4n, 4n): positive definite on what a mesh of this dimension sees."""
    seen = [3 * i + j for i in range(n) for j in range(dim)]
    seen += range(3 * n, 4 * n) if values else ()
    a = rng.normal(size=(cells, len(seen), len(seen)))
    h = np.zeros((cells, 4 * n, 4 * n))
    h[np.ix_(range(cells), seen, seen)] = a @ a.transpose(0, 2, 1)
    return h


def entries(h):
    return {(int(i), int(j)): float(h[i, j]) for i, j in np.argwhere(h)}


def reference(gradients, volume, h, n, lumped, scale):
    """Largest eigenvalues of S K S, assembled vertex by vertex; h (cells, 4n, 4n)."""
    cells, dim = gradients.shape[:2]
    every = np.concatenate([-gradients.sum(axis=1, keepdims=True), gradients], axis=1)
    g = np.zeros((cells, 4 * n, dim + 1, n))  # (∇q, mean q) of the nodal values
    for i in range(n):
        g[:, 3 * i : 3 * i + dim, :, i] = every.transpose(0, 2, 1)
        g[:, 3 * n + i, :, i] = 1 / (dim + 1)
    rest = h.copy()
    rest[:, 3 * n :, 3 * n :] = 0.0
    k = np.einsum("cxai,cxy,cybj->caibj", g, rest, g, optimize=True)
    mass = (np.ones((dim + 1, dim + 1)) + np.eye(dim + 1)) / ((dim + 1) * (dim + 2))
    if lumped:
        mass = np.eye(dim + 1) / (dim + 1)
    k += np.einsum("ab,cij->caibj", mass, h[:, 3 * n :, 3 * n :])
    k *= (dim + 1) * scale[:, None, :, None, None] * scale[:, None, None, None, :]
    size = (dim + 1) * n
    return np.linalg.eigvalsh(k.reshape(cells, size, size))[:, -1]


@pytest.mark.parametrize("lanes", LANES)
@pytest.mark.parametrize("lumped", [False, True])
@pytest.mark.parametrize("n", range(1, 8))
@pytest.mark.parametrize("dim", [1, 2, 3])
def test_dense_hessian(dim, n, lumped, lanes):
    rng = np.random.default_rng([dim, n])
    gradients, volume = simplices(rng, 21, dim)
    scale = rng.uniform(0.1, 3.0, n)
    for values in (True, False):
        h = coercive(rng, n, dim, values=values)
        found = pencil.quadratic_eigenvalues(
            geometry(gradients, volume, lanes), entries(h[0]), n, dim, lumped, scale
        )
        expected = reference(
            gradients, volume, np.repeat(h, 21, 0), n, lumped, np.tile(scale, (21, 1))
        )
        assert found.shape == (24,)
        np.testing.assert_allclose(found[:21], expected, rtol=1e-10)
        assert not found[21:].any()  # padding


@pytest.mark.parametrize("lanes", LANES)
@pytest.mark.parametrize("dim", [1, 2, 3])
def test_coefficients_and_scales_of_each_cell(dim, lanes):
    rng = np.random.default_rng(dim)
    n, cells = 3, 30
    gradients, volume = simplices(rng, cells, dim)
    h = coercive(rng, n, dim, cells)
    fixed = [(i, i) for i in range(n)]
    for key in fixed:
        h[:, key[0], key[1]] = 50.0 * (h[0, key[0], key[1]] != 0.0)
    scale = rng.uniform(0.5, 2.0, (cells, n))
    # Entries of the lower triangle, by index in the array of coefficients, and their mirrors.
    pairs = [(i, j) for i, j in np.argwhere(h[0]) if i >= j and (i, j) not in fixed]
    varying = {key: number for number, (i, j) in enumerate(pairs) for key in ((i, j), (j, i))}
    hessian = {**varying, **{key: 50.0 for key in fixed if h[0][key] != 0.0}}
    given = np.stack([h[:, i, j] for i, j in pairs], axis=1)
    found = pencil.quadratic_eigenvalues(
        geometry(gradients, volume, lanes), hessian, n, dim, False, blocked(scale, lanes),
        blocked(given, lanes),
    )  # fmt: skip
    expected = reference(gradients, volume, h, n, False, scale)
    np.testing.assert_allclose(found[:cells], expected, rtol=1e-10)
    assert not found[cells:].any()


@pytest.mark.parametrize("lumped", [False, True])
def test_sparse_hessians_fall_into_groups(lumped):
    rng = np.random.default_rng(5)
    n, dim, cells = 6, 3, 24
    gradients, volume = simplices(rng, cells, dim)
    scale = rng.uniform(0.5, 2.0, n)
    full = coercive(rng, n, dim)[0]
    component = np.r_[np.repeat(np.arange(n), 3), np.arange(n)]
    is_value = np.arange(4 * n) >= 3 * n
    cases = [  # which entries are kept: by components, and values with gradients or not
        (component[:, None] // 2 == component // 2) & (is_value[:, None] == is_value),
        (component[:, None] % 2 == component % 2) & ~(is_value[:, None] & is_value),
        (component[:, None] == component) & (is_value[:, None] == is_value),
        is_value[:, None] & is_value,
        is_value[:, None] & is_value & (component[:, None] == component) & (component == 4),
        (component[:, None] < 2) & (component < 2),
        np.zeros((4 * n, 4 * n), bool),
    ]
    for kept in cases:
        h = np.where(kept, full, 0.0)
        found = pencil.quadratic_eigenvalues(
            geometry(gradients, volume, 8), entries(h), n, dim, lumped, scale
        )
        expected = reference(
            gradients, volume, np.tile(h, (cells, 1, 1)), n, lumped, np.tile(scale, (cells, 1))
        )
        np.testing.assert_allclose(found, expected, rtol=1e-10)


@pytest.mark.parametrize("lanes", LANES)
def test_regular_cells_have_multiple_eigenvalues(lanes):
    left, _, _ = np.linalg.svd(np.eye(4) - 0.25)
    edges = left[1:, :3] - left[0, :3]
    gradients = np.repeat(np.linalg.inv(edges).T[None], 8, axis=0)
    volume = np.full(8, abs(np.linalg.det(edges)) / 6)
    h = np.zeros((8, 12, 12))
    for i in range(3):
        for j in range(3):
            h[:, 4 * i, 4 * j] += 1.3
            h[:, 3 * i + j, 3 * i + j] += 0.7
            h[:, 3 * i + j, 3 * j + i] += 0.7
    found = pencil.quadratic_eigenvalues(
        geometry(gradients, volume, lanes), entries(h[0]), 3, 3, False, np.ones(3)
    )
    expected = reference(gradients, volume, h, 3, False, np.ones((8, 3)))
    np.testing.assert_allclose(found, expected, rtol=1e-10)


@pytest.mark.parametrize("length", [1e-30, 1e30])
@pytest.mark.parametrize("stiffness", [1e-30, 1e30])
def test_extreme_units(length, stiffness):
    rng = np.random.default_rng(8)
    gradients, volume = simplices(rng, 8, 3)
    h = coercive(rng, 2, 3)
    expected = reference(gradients, volume, h[[0] * 8], 2, False, np.ones((8, 2)))
    units = np.array([length] * 6 + [1.0] * 2)  # of length, in gradients
    scaled = h[0] * stiffness * units[:, None] * units
    whole = geometry(gradients / length, volume * length**3, 8)
    found = pencil.quadratic_eigenvalues(whole, entries(scaled), 2, 3, False, np.full(2, 1e15))
    np.testing.assert_allclose(found, expected * stiffness * 1e30, rtol=1e-10)


def test_a_cell_that_is_not_finite_spoils_no_other():
    rng = np.random.default_rng(9)
    gradients, volume = simplices(rng, 16, 2)
    h = coercive(rng, 2, 2)[0]
    whole = geometry(gradients, volume, 8)
    good = pencil.quadratic_eigenvalues(whole, entries(h), 2, 2, False, np.ones(2))
    whole[0, 1, 3] = np.nan
    whole[1, 4, 6] = np.inf
    found = pencil.quadratic_eigenvalues(whole, entries(h), 2, 2, False, np.ones(2))
    assert np.argwhere(np.isnan(found)).ravel().tolist() == [3, 14]
    kept = ~np.isnan(found)
    np.testing.assert_array_equal(found[kept], good[kept])


@pytest.mark.parametrize("lanes", LANES)
def test_results_do_not_depend_on_the_cells_beside(lanes):
    rng = np.random.default_rng(10)
    gradients, volume = simplices(rng, 33, 3)
    order, h = rng.permutation(33), entries(coercive(rng, 3, 3)[0])
    found, again = (
        pencil.quadratic_eigenvalues(
            geometry(gradients[o], volume[o], lanes), h, 3, 3, False, np.ones(3)
        )[:33]
        for o in (slice(None), order)
    )
    np.testing.assert_array_equal(again, found[order])


def test_arrays_that_do_not_fit_are_refused():
    whole = np.ones((1, 4, 8))
    with pytest.raises(ValueError, match="needs √"):
        pencil.quadratic_eigenvalues(whole, {}, 1, 2, False, np.ones(1))
    with pytest.raises(ValueError, match="coefficients"):
        pencil.quadratic_eigenvalues(whole, {(0, 0): 2}, 1, 1, False, np.ones(1))
    with pytest.raises(ValueError, match="scale"):
        pencil.quadratic_eigenvalues(whole, {(0, 0): 2.0}, 1, 1, False, np.ones(2))
    with pytest.raises(ValueError, match="4 or 8"):
        pencil.matrix_eigenvalues(np.ones((1, 2, 2)), np.ones(2), lanes=3)


def spectrum(kind, m, rng):
    """Eigenvalues, the largest of which are simple, multiple, or nearly so."""
    values = 0.9 * rng.uniform(size=m)
    near = {"simple": 0.1, "near": 1e-4, "nearer": 1e-8, "double": 0.0}
    if kind in near:
        values[0], values[1 % m] = 1.0 - near[kind], 1.0
    elif kind == "triple":
        values[:3] = 1.0
    elif kind == "sixfold":
        values[:6] = 1.0
    elif kind == "equal":
        values[:] = 1.0
    elif kind == "rank 1":
        values[1:] = 0.0
    elif kind == "rank 3":
        values[:3], values[3:] = 1.0, 0.0
    elif kind == "crowded":
        values = 1.0 - np.linspace(0.0, 1.0, m) ** 4
    elif kind == "wide":
        values = 10.0 ** rng.uniform(-16, 0, m)
    elif kind == "negative":
        values = -values - 0.1
    else:
        values = rng.normal(size=m)
    return values


KINDS = ["simple", "near", "nearer", "double", "triple", "sixfold", "equal", "rank 1", "rank 3",
         "crowded", "wide", "negative", "indefinite"]  # fmt: skip


@pytest.mark.parametrize("lanes", LANES)
@pytest.mark.parametrize("m", [1, 2, 3, 5, 8, 13, 24, 48, 60])
def test_given_matrices(m, lanes):
    rng = np.random.default_rng(m)
    matrices = []
    for kind in KINDS:
        for _ in range(3):
            q, _ = np.linalg.qr(rng.normal(size=(m, m)))
            matrices.append((q * spectrum(kind, m, rng)) @ q.T)
    matrices += [np.diag(spectrum("simple", m, rng)), np.eye(m), np.ones((m, m))]
    matrices += [2 * np.eye(m) - np.eye(m, k=1) - np.eye(m, k=-1)]
    a = np.array(matrices)
    a = (a + a.transpose(0, 2, 1)) / 2
    found = pencil.matrix_eigenvalues(a, np.ones(m), lanes)
    expected = np.linalg.eigvalsh(a)[:, -1]
    norm = np.abs(np.linalg.eigvalsh(a)).max(axis=1)
    assert np.all(np.abs(found - expected) <= 1e-11 * norm)
    assert np.all(found >= expected - 1e-14 * m * norm)  # never from below
    for scale in (rng.uniform(0.1, 10.0, m), rng.uniform(0.1, 10.0, (len(a), m))):
        found = pencil.matrix_eigenvalues(a, scale, lanes)
        wide = np.broadcast_to(scale, (len(a), m))
        values = np.linalg.eigvalsh(a * wide[:, :, None] * wide[:, None, :])
        assert np.all(np.abs(found - values[:, -1]) <= 1e-11 * np.abs(values).max(axis=1))


@pytest.mark.parametrize("lanes", LANES)
def test_given_matrices_of_any_size_zero_and_not_finite(lanes):
    rng = np.random.default_rng(2)
    cells, m = 19, 12
    a = rng.normal(size=(cells, m, m))
    a = a @ a.transpose(0, 2, 1)
    expected = np.linalg.eigvalsh(a)[:, -1]
    size = 10.0 ** rng.uniform(-30, 30, cells)
    found = pencil.matrix_eigenvalues(a * size[:, None, None], np.full(m, 1e-20), lanes)
    np.testing.assert_allclose(found, expected * size * 1e-40, rtol=1e-11)
    a[4] = 0.0
    a[7, 3, 11], a[8, 2, 2], a[18, 11, 0] = np.nan, np.inf, -np.inf
    found = pencil.matrix_eigenvalues(a, np.ones(m), lanes)
    assert found[4] == 0.0
    assert np.argwhere(np.isnan(found)).ravel().tolist() == [7, 8, 18]
    good = ~np.isnan(found)
    good[4] = False
    np.testing.assert_allclose(found[good], expected[good], rtol=1e-11)
    scale = np.ones((cells, m))
    scale[2], scale[3, 3], scale[5, 1] = 0.0, np.nan, np.inf
    found = pencil.matrix_eigenvalues(a, scale, lanes)
    assert found[2] == 0.0
    assert np.argwhere(np.isnan(found)).ravel().tolist() == [3, 5, 7, 8, 18]
    assert pencil.matrix_eigenvalues(a[:0], np.ones(m), lanes).shape == (0,)
