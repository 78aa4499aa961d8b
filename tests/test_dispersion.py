# SPDX-License-Identifier: LGPL-3.0-or-later
"""``Body.dispersion``: closed forms, states of nonlinear bodies, decades of scale, refusals."""

import itertools

import dolfinx
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
import ufl
from dolfinx import fem

import complexbody as cb
from complexbody import _compat, forms
from complexbody.dispersion_picture import branches
from complexbody.errors import BodyError
from complexbody.waves import plane_waves

pytestmark = pytest.mark.serial
Q = np.array([0.3, 1.0, 4.0])
AXES = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, -2, 2)]


def unit(axis):
    return np.array(axis) / np.linalg.norm(axis)


def coupled(a, b, coupling):
    """Both ω > 0 of (a − ω²)(b − ω²) = coupling."""
    middle, half = (a + b) / 2, np.sqrt(((a - b) / 2) ** 2 + coupling)
    return np.sqrt(np.maximum([middle - half, middle + half], 0.0))


def positive(omega):
    """Re ω > 0, sorted; nothing decays."""
    np.testing.assert_allclose(omega.imag, 0.0, atol=1e-12 * abs(omega).max())
    return np.sort(omega.real[..., omega.shape[-1] // 2 :], axis=-1)


@pytest.mark.parametrize("axis", AXES)
def test_cosserat(axis):
    """Longitudinal, microrotation along q, and the transverse pair twice, in any direction."""
    c = {"lam": 2.0, "mu": 0.9, "kappa": 0.5, "alpha": 0.1, "beta": 0.2, "gamma": 0.6}
    body, j = forms.cosserat(**c, density=1.3, micro_inertia=0.4), 1.3 * 0.4
    for q in Q:
        pair = coupled(1.4 * q**2 / 1.3, (0.6 * q**2 + 1.0) / j, 0.25 * q**2 / (1.3 * j))
        along = np.sqrt([4.3 * q**2 / 1.3, (0.9 * q**2 + 1.0) / j])
        found = positive(body.dispersion(q * unit(axis)))
        np.testing.assert_allclose(found, np.sort([*along, *pair, *pair]), rtol=1e-12)


def test_cosserat_plane():
    """In the plane one transverse pair is left; u3 has the modulus μ + κ where φ1 = φ2 = 0."""
    for d, q in itertools.product((2, 3), Q):
        body = forms.plane_cosserat(2.0, 0.9, 0.5, 0.6, 1.3, 0.4, d=d)
        pair = coupled(1.4 * q**2 / 1.3, (0.6 * q**2 + 1.0) / 0.52, 0.25 * q**2 / (1.3 * 0.52))
        rest = np.array([4.3, 1.4])[: d - 1] * q**2 / 1.3
        found = positive(body.dispersion(q * unit((3, -1))))
        np.testing.assert_allclose(found, np.sort([*pair, *np.sqrt(rest)]), rtol=1e-12)


def test_mindlin_bar():
    """Acoustic and optical branches; √(A/ρ) q at long waves, the cut-off √(B/ρ̄) at q = 0."""
    body = forms.mindlin_bar(1.5, 0.7, 0.2, 1.1, 0.3)
    for q in Q:
        exact = coupled(2.2 * q**2 / 1.1, (0.2 * q**2 + 0.7) / 0.3, (0.7 * q) ** 2 / (1.1 * 0.3))
        np.testing.assert_allclose(positive(body.dispersion(q)), exact, rtol=1e-12)
    low, high = positive(body.dispersion(1e-4))
    assert low / 1e-4 == pytest.approx(np.sqrt(1.5 / 1.1), rel=1e-7)
    assert high == pytest.approx(np.sqrt(0.7 / 0.3), rel=1e-7)


@pytest.mark.parametrize("d", [2, 3])
def test_micromorphic_cut_offs(d):
    """At q = 0: dilatation, shears and rotations of ψ; d of no frequency."""
    body = forms.micromorphic(1.0, 1.0, 0.3, 1.0, 0.2, 0.1, 0.1, 0.1, 1.0, 0.5, d=d)
    shears, turns = d * (d + 1) // 2 - 1, d * (d - 1) // 2
    squares = [0.0] * d + [d * 0.3 + 1.2] + [1.2] * shears + [0.8] * turns
    found = positive(body.dispersion(0.0))
    np.testing.assert_allclose(found, np.sort(np.sqrt(np.array(squares) / 0.5)), atol=1e-12)


@pytest.mark.parametrize("axis", AXES)
def test_voids(axis):
    """Cowin and Nunziato's pair; transverse waves do not feel the voids."""
    body = forms.elastic_voids(2.0, 0.9, 0.3, 1.5, 0.8, 1.2, 0.4)
    for q in Q:
        pair = coupled(3.8 * q**2 / 1.2, (0.3 * q**2 + 1.5) / 0.4, (0.8 * q) ** 2 / (1.2 * 0.4))
        exact = np.sort([*pair, *[q * np.sqrt(0.9 / 1.2)] * 2])
        found = positive(body.dispersion(q * unit(axis)))
        np.testing.assert_allclose(found, exact, rtol=1e-12)


def roots(*pairs):
    """All ω of (ρω² − a)(ρ̄ω² + iωη − b) = t, for each (ρ, a, ρ̄, η, b, t)."""
    found = []
    for rho, a, bar, eta, b, t in pairs:
        left, right = np.array([rho, 0, -a]), np.array([bar, 1j * eta, -b])
        product = np.polymul(left, right[np.flatnonzero(right)[0] :])
        product[-1] -= t
        found.extend(np.roots(product))
    return np.array(found)


def same(found, exact, rtol=1e-9):
    """Both have the same numbers, in any order."""
    assert len(found) == len(exact)
    distance = abs(found[:, None] - exact)
    rows, columns = scipy.optimize.linear_sum_assignment(distance)
    assert distance[rows, columns].max() < rtol * abs(exact).max()


@pytest.mark.parametrize("axis", AXES)
def test_two_fields_damped(axis):
    """Longitudinal and transverse pairs with η; k0 and the null ρ̄ too."""
    c = {"lam": 0.8, "mu": 0.9, "k0": 0.7, "k1": 0.5, "k2": 0.6, "k2_skew": 0.3,
         "k3": 0.2, "k3_sym": 0.25}  # fmt: skip
    for bar, q in itertools.product((0.5, 0.0), Q):
        body = forms.isotropic_two_field(**c, density=1.2, inertia=bar, viscosity=0.6)
        moduli = [(2.6, 1.7, 0.45), (0.9, 0.9, 0.125), (0.9, 0.9, 0.125)]
        pairs = [(1.2, a * q**2, bar, 0.6, k * q**2 + 0.7, (r * q**2) ** 2) for a, k, r in moduli]
        same(body.dispersion(q * unit(axis)), roots(*pairs))


def test_microcracked_along_the_normal():
    """Opening and sliding, as the form's docstring has them."""
    normal = np.array([1.0, 2.0, -2.0])
    body = forms.microcracked(1.0, 1.1, 1.2, 0.5, 0.6, 0.3, 0.2, 0.25, -0.3, -0.6, normal,
                              1.3, 0.5, 0.2)  # fmt: skip
    for q in Q:
        pairs = [(1.3, a * q**2, 0.5, 0.2, k * q**2 + 1.2, (r * q**2) ** 2 + (c * q) ** 2)
                 for a, k, r, c in ((3.2, 1.7, 0.45, -0.9), *[(1.1, 0.9, 0.125, -0.3)] * 2)]
        same(body.dispersion(q * unit(normal)), roots(*pairs))


@pytest.mark.parametrize("bar", [0.0, 0.1])
def test_nematic_elastomer_along_the_director(bar):
    """Sound, and the director with shear, twice."""
    for axis, q in itertools.product(range(3), Q):
        body = forms.nematic_elastomer(2.0, 1.0, 0.5, 1.0, 0.05, 1.2, bar, 0.3, axis)
        S, T = 1.0 + 0.125 + 0.5, 0.75
        pair = (1.2, S * q**2, bar, 0.3, 0.05 * q**2 + 0.5, (T * q) ** 2)
        sound = q * np.sqrt(4 / 1.2)
        same(body.dispersion(q * np.eye(3)[axis]), np.r_[roots(pair, pair), sound, -sound])


def test_nematic_relaxation():
    """5CB: −Im ω = Kq²/γ1, fifteen decades below its sound, to round-off."""
    for q in (1e2, 1e5):
        omega = forms.nematic_director().dispersion((0.0, q))
        slow = omega[np.argmin(abs(omega))]
        assert -slow.imag == pytest.approx(6e-12 * q**2 / 0.08, rel=1e-12)
        assert abs(slow.real) < 1e-12 * abs(slow.imag)


@pytest.mark.parametrize("inertia", [0.0, 5100.0])
def test_twenty_decades(inertia):
    """Real Al-Pd-Mn: the phason diffuses at the rate of K_νν − K_νu K_uu⁻¹ K_uν, to 1e-9."""
    from complexbody.dispersion import linearised
    from complexbody.waves import wave_matrix

    body, q = forms.icosahedral_quasicrystal(inertia=inertia), np.array([600.0, 0.0, 800.0])
    K = wave_matrix(linearised(body)[0], q)
    still = K[3:, 3:] - K[3:, :3] @ np.linalg.solve(K[:3, :3], K[:3, 3:])
    rates = np.linalg.eigvalsh(still) / body.viscosity
    omega = body.dispersion(q)
    slow = np.sort(-omega.imag[np.argsort(abs(omega))[:3]])
    np.testing.assert_allclose(slow, rates, rtol=1e-9)


def test_small_frequencies_beside_large_ones():
    """Magnesium's voids at a wave length of 6 m: ω 1e8 times below the optical one, to 1e-12."""
    q, c = 1.0, forms.elastic_voids().constants
    low = positive(forms.elastic_voids().dispersion(q))[2]
    full, own = c["lambda_"] + 2 * c["mu"], c["xi"]
    static = np.sqrt((full - c["b"] ** 2 / own) / 1740.0)
    assert low / q == pytest.approx(static, rel=1e-12)


def test_bubbly():
    """Commander and Prosperetti, from the linear body and from the full χ and w alike."""
    scaled = {"radius": 0.1, "void_fraction": 0.05, "density": 1.0, "sound_speed": 1.0,
              "pressure": 0.02, "gamma": 1.4}  # fmt: skip
    for linear, q in itertools.product((True, False), Q):
        body = forms.bubbly_liquid(**scaled, linearised=linear)
        omega = positive(body.dispersion(q))
        np.testing.assert_allclose(omega[2:], forms.bubbly_branches(q, **scaled), rtol=1e-10)
        assert not omega[:2].any()  # nothing holds shear
        damped = forms.bubbly_liquid(**scaled, viscosity=0.01, linearised=linear, d=1)
        omega = damped.dispersion(q)
        found = forms.bubbly_dispersion(omega, **scaled, viscosity=0.01)
        np.testing.assert_allclose(found, q**2, rtol=1e-9)


def test_state_of_a_nonlinear_body():
    """Two wells: at ν = ±1 stiffness 2, at 0 a growth; a prestretch U shifts the wave speed."""

    def energy(U, nu, N):
        wells = 0.25 * (nu[0] ** 2 - 1) ** 2
        return wells + 0.5 * N[0, 0] ** 2 + ufl.exp(U[0, 0]) - U[0, 0] + 0.5 * U[0, 1] ** 2

    body = cb.Body(1, energy, 2.0, 0.5, displacement=1)
    for nu, square in ((1.0, 2.0), (-1.0, 2.0), (0.0, -1.0)):
        omega = body.dispersion(3.0, U=[[0.4, 0, 0]], nu=nu)
        exact = np.sqrt(np.array([9 * np.exp(0.4) / 2, (9 + square) / 0.5], complex))
        same(omega, np.r_[exact, -exact], 1e-12)
    growing = body.dispersion(0.1, nu=0.0)
    assert growing.imag.max() == pytest.approx(np.sqrt((1 - 0.01) / 0.5))
    with pytest.raises(BodyError, match="not at rest"):
        body.dispersion(1.0, nu=0.9)


def test_general_inertia():
    """χ with a mass of ν's own and a gyroscopic term: (K − iωG − ω²M) a = 0 at the state."""

    def chi(nu, rate):
        gyro = nu[0] * rate[1] - nu[1] * rate[0]
        return 0.5 * (1 + nu[0] ** 2) * ufl.inner(rate, rate) + 0.35 * gyro

    def energy(U, nu, N):
        return 0.5 * ufl.inner(U, U) + 0.5 * ufl.inner(N, N) + 0.5 * (nu[0] ** 2 + 2 * nu[1] ** 2)

    body, q = cb.Body(2, energy, 1.0, chi, displacement=1), 0.8
    omega = body.dispersion(q)
    # M ν̈ + b J ν̇ + K ν = 0, b = 0.7
    a, b = q**2 + 1, q**2 + 2
    squares = np.roots([1.0, -(a + b + 0.49), a * b])
    exact = np.sqrt(np.r_[squares, q**2])
    same(omega, np.r_[exact, -exact].astype(complex), 1e-12)


def test_shapes_and_polarisations():
    """Arrays of wave vectors keep their shape; (K − iωD − ω²M) a = 0."""
    from complexbody.dispersion import linearised
    from complexbody.waves import wave_matrix

    body = forms.scaled_icosahedral_quasicrystal()
    q = np.random.default_rng(0).normal(size=(4, 2, 3))
    omega, a = body.dispersion(q, polarisations=True)
    assert omega.shape == (4, 2, 12) and a.shape == (4, 2, 6, 12)
    np.testing.assert_array_equal(omega[1, 1], body.dispersion(q[1, 1]))
    np.testing.assert_array_equal(body.dispersion(2.0), body.dispersion((2.0, 0.0)))
    H, M, D = linearised(body)
    for at in np.ndindex(4, 2):
        K = wave_matrix(H, q[at])
        for w, vector in zip(omega[at], a[at].T, strict=True):
            assert abs((K - 1j * w * D - w**2 * M) @ vector).max() < 1e-11 * abs(K).max()
            assert np.linalg.norm(vector) == pytest.approx(1.0)


def test_random_bodies():
    """Against numpy's plain companion matrix: full Ω and η, chiral K, missing inertia."""
    rng = np.random.default_rng(3)
    for case in range(30):
        n, light = 4, case % 3
        real, imag = rng.normal(size=(3, n, n)), rng.normal(size=(n, n))
        D, M = (A @ A.T for A in real[1:])
        K, D = (real[0] + 1j * imag) @ (real[0] + 1j * imag).conj().T, D * (case % 2)
        if light:
            M[:, n - light :] = M[n - light :] = 0.0
            D = D + np.diag(np.arange(n) >= n - light)
        A = np.block([[np.zeros((n, n)), np.eye(n)], [-K, -D]])
        B = scipy.linalg.block_diag(np.eye(n), M)
        s = scipy.linalg.eigvals(A, B)
        same(plane_waves(K, M, D)[0], 1j * s[np.isfinite(s) & (abs(s) < 1e8)], 1e-7)


def test_times(capsys):
    """Times are those of the formulas, and print as a table."""
    scales = forms.isotropic_two_field(d=1, viscosity=9.0, k0=0.1).scales(0.1, 2.0, 1)
    found = {(s.field, s.what): s.seconds for s in scales}
    assert found["u", "a wave crosses a cell"] == pytest.approx(0.1 / np.sqrt(3))
    assert found["nu", "relaxation"] == pytest.approx(90.0)
    print(scales)
    assert "relaxation" in capsys.readouterr().out


def test_refusals():
    """What has no plane waves is refused in words."""
    body = forms.mindlin_bar()
    for q in ((1, 2, 3, 4), np.nan, np.zeros((3, 0))):
        with pytest.raises(BodyError, match="Give one number along x"):
            body.dispersion(q)
    for state in ({"nu": [1, 2]}, {"U": np.nan}, {"N": "zero"}):
        with pytest.raises(BodyError, match="Give a finite number, or an array of shape"):
            body.dispersion(1.0, **state)
    for sizes in ((0.0, 1.0), (1.0, -1.0), (1.0, 1.0, 4)):
        with pytest.raises(BodyError, match="Give positive lengths"):
            body.scales(*sizes)
    root = cb.Body(1, lambda U, nu, N: ufl.sqrt(ufl.inner(U, U)), 1.0, 1.0, displacement=1)
    with pytest.raises(BodyError, match="no second derivative"):
        root.dispersion(1.0)
    weightless = cb.Body(1, lambda U, nu, N: ufl.inner(U, U) + ufl.inner(N, N), 1.0,
                         lambda nu, rate: rate[0] ** 4, displacement=1)  # fmt: skip
    with pytest.raises(BodyError, match="neither inertia nor viscosity"):
        weightless.dispersion(1.0)


def test_coefficients_that_vary(comm):
    """Functions are refused; Constants are numbers."""
    mesh = dolfinx.mesh.create_interval(comm, 4, [0.0, 1.0])
    stiff, number = fem.Function(_compat.cell_space(mesh)), fem.Constant(mesh, 4.0)

    def body(c, density=1.0):
        return cb.Body(1, lambda U, nu, N: 0.5 * c * ufl.inner(U, U) + 0.5 * ufl.inner(N, N),
                       density, 1.0, displacement=1)  # fmt: skip

    np.testing.assert_allclose(positive(body(number).dispersion(3.0)), [3.0, 6.0])
    for varying in (body(stiff), body(1.0, stiff)):
        with pytest.raises(BodyError, match="reads a Function"):
            varying.dispersion(1.0)


def squares(U, nu, N):
    """Shear of u coupled to two components of ν; antiplane waves have no loss."""
    strain = ufl.sym(U)
    coupled = nu[0] * (strain[0, 0] - strain[1, 1]) + 2 * nu[1] * strain[0, 1]
    return (0.5 * ufl.tr(strain) ** 2 + ufl.inner(strain, strain) + 0.2 * ufl.inner(N, N)
            + 0.5 * ufl.inner(nu, nu) + 0.3 * coupled)  # fmt: skip


def test_plot(tmp_path):
    """Branches are followed through crossings; three panels, written to a file."""
    body, q = forms.microcracked(c1=0.0, c2=0.0, k3=0.0, k3_sym=0.0), np.linspace(0, 4, 60)
    followed = branches(body, (0, 0, 2), q)
    assert abs(np.diff(followed, 2, axis=0)).max() < 0.02
    np.testing.assert_allclose(np.sort_complex(followed[7]),
                               np.sort_complex(body.dispersion((0, 0, q[7]))))  # fmt: skip
    # Phase speeds hardly change in the first steps, where no slope is known: no branch is another.
    lossy = cb.Body(2, squares, 1.0, 0.5, np.diag([0.05, 0.4]))
    q0 = np.linspace(0.05, 20, 100)
    speeds = branches(lossy, (1.0,), q0).real / q0[:, None]
    assert np.abs(np.diff(speeds[:4], axis=0)[:, 5:8]).max() < 0.02
    decay = cb.plot_dispersion(lossy, q0)[1]
    assert min(np.nanmin(line.get_ydata(), initial=1.0) for line in decay.lines) > 1e-9
    axes = cb.plot_dispersion(body, q, (0, 0, 2), tmp_path / "new" / "waves.png")
    assert (tmp_path / "new" / "waves.png").stat().st_size > 10_000
    assert [ax.get_xlabel() for ax in axes] == ["wave number q [1/m]"] * 3
    top = np.nanmax([line.get_ydata()[-1] for line in axes[0].lines])
    assert top == pytest.approx(body.dispersion((0, 0, 4.0)).real.max())
    assert cb.plot_dispersion(forms.cosserat(), 1e3 * q, axes=axes) is axes
    for bad in ({"direction": (0, 0)}, {"q": q[::-1]}, {"axes": axes[:2]}):
        with pytest.raises(BodyError, match="Give"):
            cb.plot_dispersion(body, **({"q": q} | bad))
