# SPDX-License-Identifier: LGPL-3.0-or-later
"""Cosserat, micromorphic, microcracked, nematic bodies: coercive exactly where accepted; symmetry.

Energies are linear in their constants, so that H of any is a sum of unit Hessians. They are taken
on (sym U, ν, N): where e feels skw U, it does so beside ν, which takes its place.
"""

from __future__ import annotations

import functools
import itertools
import math

import numpy as np
import pytest

from complexbody import forms
from complexbody.errors import BodyError, CoercivityError
from complexbody.forms.cosserat import _energy as cosserat_energy
from complexbody.forms.microcracked import _energy as cracked_energy
from complexbody.forms.micromorphic import _energy as micromorphic_energy
from complexbody.forms.nematic import _elastomer
from complexbody.hessian import read

pytestmark = pytest.mark.serial
COSSERAT = {"lam": 0.8, "mu": 0.9, "kappa": 0.5, "alpha": 0.1, "beta": 0.2, "gamma": 0.6}
PLANE = {name: COSSERAT[name] for name in ("lam", "mu", "kappa", "gamma")}
MINDLIN = {"lam": 0.8, "mu": 0.9, "b1": 0.3, "b2": 1.0, "b3": 0.2, "g1": 0.1, "g2": 0.15, "C": 0.4}
CRACKS = {"lam": 0.8, "mu": 0.9, "k0": 1.1, "k1": 0.5, "k2": 0.6, "k2_skew": 0.3,
          "k3": 0.2, "k3_sym": 0.25, "c1": -0.3, "c2": -0.6}  # fmt: skip
RUBBER = {"lam": 0.8, "mu": 0.9, "D1": 0.5, "D2": 0.7, "K": 0.3}
NORMALS = {1: [-1.0], 2: [0.6, 0.8], 3: [2 / 3, -1 / 3, 2 / 3]}


def cracked(d):
    return (
        lambda **c: forms.microcracked(d=d, normal=NORMALS[d], **c),
        lambda **c: cracked_energy(d, NORMALS[d], **c),
        CRACKS, (d, d, d),
    )  # fmt: skip


def mindlin(d):
    return (
        lambda **c: forms.micromorphic(d=d, **c), lambda **c: micromorphic_energy(d, **c),
        MINDLIN, (d, d * d, d),
    )  # fmt: skip


#: family -> (body of constants, energy whatever they are, admissible constants, (n_u, k, d))
FAMILIES = {
    "Cosserat": (forms.cosserat, lambda **c: cosserat_energy(3, 3, **c), COSSERAT, (3, 3, 3)),
    "Cosserat, plane": (
        forms.plane_cosserat, lambda **c: cosserat_energy(2, 1, **c), PLANE, (2, 1, 2)),
    **{f"micromorphic, {d}D": mindlin(d) for d in (1, 2, 3)},
    **{f"microcracked, {d}D": cracked(d) for d in (1, 2, 3)},
    "nematic elastomer": (
        lambda **c: forms.nematic_elastomer(axis=1, **c),
        lambda **c: _elastomer(1, **c), RUBBER, (3, 2, 3)),
}  # fmt: skip


def fast_hessian(energy, n_u, k, d):
    """H on (sym U, ν, N), columns of the mesh's dimensions, in the order of ``hessian``."""
    found, n = read(energy, None, n_u, k, "gradients"), n_u + k
    H, columns, unit = np.zeros((4 * n, 4 * n)), [], np.eye(4 * n)
    for at, value in found.hessian.items():
        H[at] = value
    for i, j in itertools.product(range(d), repeat=2):
        if i <= j:
            columns.append(0.5 * (unit[3 * i + j] + unit[3 * j + i]))
    for i in range(k):
        columns += [unit[3 * n + n_u + i], *(unit[3 * (n_u + i) + j] for j in range(d))]
    return np.array(columns) @ H @ np.array(columns).T


@functools.cache
def unit_hessians(family):
    """H of each constant alone."""
    _, energy, constants, shape = FAMILIES[family]
    zero = dict.fromkeys(constants, 0.0)
    return {name: fast_hessian(energy(**(zero | {name: 1.0})), *shape) for name in constants}


def total(units, c):
    return sum(c[name] * H for name, H in units.items())


@pytest.mark.parametrize("family", FAMILIES)
def test_coercive_iff_hessian_is(family, hessian):
    """Of 400 random bodies those with H > 0 are accepted, and no others; both come up."""
    make, _, constants, shape = FAMILIES[family]
    units, rng, seen = unit_hessians(family), np.random.default_rng(5), []
    if shape[1] < 9:  # by polarisation, which takes its time
        H = hessian(make(**constants).energy, *shape, True)
        np.testing.assert_allclose(H, total(units, constants), atol=1e-12)
    signed = {"alpha", "beta", "lam", "b1", "b3", "g1", "g2", "k1", "k3", "k3_sym", "c1", "c2",
              "D2"}  # fmt: skip
    for _ in range(400):
        # mostly admissible signs
        c = {name: rng.uniform(-0.6 if name in signed else -0.05, 1.5) for name in constants}
        lowest = np.linalg.eigvalsh(total(units, c)).min()
        if abs(lowest) < 1e-9:
            continue
        try:
            make(**c)
        except CoercivityError:
            assert lowest < 0
        else:
            assert lowest > 0
        seen.append(lowest > 0)
    assert 0.03 < np.mean(seen) < 0.97


def edges():
    """(family, inequality, constants on the boundary, which to move, which way is inward)."""
    yield "Cosserat", "kappa > 0", COSSERAT | {"kappa": 0.0}, "kappa", 1
    yield "Cosserat", "2*mu + kappa > 0", COSSERAT | {"mu": -0.25, "lam": 2.0}, "mu", 1
    yield "Cosserat", "3*lam + 2*mu + kappa", COSSERAT | {"lam": -2.3 / 3}, "lam", 1
    yield "Cosserat", "3*alpha + beta + gamma", COSSERAT | {"alpha": -0.8 / 3}, "alpha", 1
    yield "Cosserat", "gamma + beta > 0", COSSERAT | {"beta": -0.6, "alpha": 1.0}, "beta", 1
    yield "Cosserat", "gamma - beta > 0", COSSERAT | {"beta": 0.6}, "beta", -1
    yield "Cosserat, plane", "kappa > 0", PLANE | {"kappa": 0.0}, "kappa", 1
    yield "Cosserat, plane", "gamma > 0", PLANE | {"gamma": 0.0}, "gamma", 1
    yield "Cosserat, plane", "2*mu + kappa > 0", PLANE | {"mu": -0.25, "lam": 2.0}, "mu", 1
    yield "Cosserat, plane", "2*lam + 2*mu + kappa", PLANE | {"lam": -2.3 / 2}, "lam", 1
    for d in (1, 2, 3):
        family, macro, micro = f"micromorphic, {d}D", d * 0.8 + 1.8, d * 0.3 + 1.2
        bound = (math.sqrt(macro * micro) - 0.3) / d
        yield family, "*g1 + 2*g2)**2", MINDLIN | {"g1": bound}, "g1", -1
        alone = MINDLIN | {"g1": 0.0, "g2": 0.0}
        yield family, f"{d}*lam + 2*mu > 0", alone | {"lam": -1.8 / d}, "lam", 1
        yield family, f"{d}*b1 + b2 + b3 > 0", alone | {"b1": -1.2 / d}, "b1", 1
        yield family, "C > 0", MINDLIN | {"C": 0.0}, "C", 1
        if d > 1:
            shear = math.sqrt(0.9 * 1.2 / 2)
            yield family, "2*g2**2", MINDLIN | {"g2": shear, "g1": -2 * shear / d}, "g2", -1
            yield family, "b2 > b3", MINDLIN | {"b3": 1.0}, "b3", -1
            yield family, "mu > 0", alone | {"mu": 0.0}, "mu", 1
            yield family, "b2 + b3 > 0", alone | {"b3": -1.0, "b1": 2.0}, "b3", 1
        volume = 0.8 + 1.8 / d - (0.2 + 0.25 / d) ** 2 / (0.5 + 1.2 / d)
        G = 0.9 - 0.25**2 / 2.4
        need = (0.3 + 0.6 / d) ** 2 / volume + (0.36 * (1 - 1 / d) / (2 * G))
        family = f"microcracked, {d}D"
        yield family, "c1 + c2/d", CRACKS | {"k0": need}, "k0", 1
        if d > 1:  # without a mean pull opening needs less than sliding only if d = 2
            need = 0.36 / (4 * G)
            c = CRACKS | {"k0": need, "c1": 0.3 if d == 2 else 0.2}
            yield family, "c2**2", c | {"k0": need if d == 2 else 0.36 * (1 - 1 / d) / (2 * G)}, (
                "k0"), 1  # fmt: skip
            yield family, "4*mu*k2 > k3_sym**2", CRACKS | {
                "k3_sym": math.sqrt(4 * 0.9 * 0.6), "k3": -math.sqrt(4 * 0.9 * 0.6) / d, "k0": 1e9,
            }, "k3_sym", -1  # fmt: skip
    yield "nematic elastomer", "D2**2", RUBBER | {"D2": math.sqrt(4 * 0.9 * 0.5)}, "D2", -1
    yield "nematic elastomer", "D2**2", RUBBER | {"D2": -math.sqrt(4 * 0.9 * 0.5)}, "D2", 1
    yield "nematic elastomer", "3*lam + 2*mu", RUBBER | {"lam": -0.6}, "lam", 1
    for name in ("mu", "D1", "K"):
        yield "nematic elastomer", f"{name} > 0", RUBBER | {"D2": 0.0, name: 0.0}, name, 1


@pytest.mark.parametrize(("family", "inequality", "edge", "constant", "inward"), list(edges()))
def test_coercive_exactly_inside(family, inequality, edge, constant, inward, lowest):
    """1e-6 inside: accepted and H > 0; 1e-6 outside: refused by name, and H is indefinite."""
    make, units = FAMILIES[family][0], unit_hessians(family)
    inside, outside = (edge | {constant: edge[constant] + s * 1e-6 * inward} for s in (1, -1))
    assert make(**inside).constants == inside
    assert lowest(total(units, inside)) > 0
    with pytest.raises(CoercivityError) as error:
        make(**outside)
    assert inequality in str(error.value)
    assert lowest(total(units, outside)) < 0


@pytest.mark.parametrize("family", FAMILIES)
def test_constants_are_finite_numbers(family):
    """NaN and words are refused by the name of the constant."""
    make, _, constants, _ = FAMILIES[family]
    for name in constants:
        for bad in (math.nan, "one"):
            with pytest.raises(BodyError, match=rf"\b{name} is .*not a finite number"):
                make(**(constants | {name: bad}))


def test_lakes_foam(hessian):
    """Technical constants and back; Ψ = 3/2 leaves ∇φ ∝ I as the only null mode, waves stiff."""
    c = forms.cosserat().constants
    G, twist = c["mu"] + c["kappa"] / 2, c["beta"] + c["gamma"]
    assert pytest.approx(104e6) == G
    assert c["lam"] / (2 * c["lam"] + 2 * G) == pytest.approx(0.4)
    assert c["kappa"] / (2 * (c["mu"] + c["kappa"])) == pytest.approx(0.04)
    assert math.sqrt(twist / (2 * G)) == pytest.approx(0.62e-3)
    assert math.sqrt(c["gamma"] / (4 * G)) == pytest.approx(0.327e-3)
    assert twist / (c["alpha"] + twist) == pytest.approx(1.5)
    H = hessian(forms.cosserat().energy, 3, 3, 3, True)
    values, modes = np.linalg.eigh(H)
    null = modes[:, 0]  # beside 1e8 Pa of others: nine entries of ∇φ carry it
    curvature = H[np.ix_(range(6, 18), range(6, 18))]
    assert abs(null @ H @ null) < 1e-9 * abs(curvature).max()
    assert np.sum(abs(null) > 1e-6) == 3 and values[1] > 1.0
    assert (forms.cosserat().dispersion(1e3 * np.eye(3))[:, 6:].real > 1e5).all()
    for bad in ({"poisson": 0.5}, {"N2": 0.0}, {"N2": 1.0}, {"Psi": 0.0}, {"Psi": 1.6}):
        with pytest.raises(BodyError, match="Give poisson"):
            forms.cosserat_constants(**bad)
    with pytest.raises(BodyError, match="j is nan"):
        forms.cosserat(micro_inertia=math.nan)


def random(rng, *shapes):
    return [rng.normal(size=shape) for shape in shapes]


def turned(family, Q, U, nu, N):
    """What a rotation Q of body and lattice makes of a state."""
    if family == "micromorphic":
        psi, grad = nu.reshape(3, 3), N.reshape(3, 3, 3)
        grad = np.einsum("ia,jb,kc,abc->ijk", Q, Q, Q, grad)
        return Q @ U @ Q.T, (Q @ psi @ Q.T).ravel(), grad.reshape(9, 3)
    return Q @ U @ Q.T, Q @ nu, Q @ N @ Q.T


@pytest.mark.parametrize("family", ["Cosserat", "micromorphic", "microcracked"])
def test_isotropic_and_objective(family, value):
    """Rotations change nothing, nor does a rigid rotation with the ν that turns along."""
    rng = np.random.default_rng(1)
    Q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    Q *= np.linalg.det(Q)
    k = 9 if family == "micromorphic" else 3
    U, nu, N = random(rng, (3, 3), k, (k, 3))
    m = np.array(NORMALS[3])
    before, after = {
        "Cosserat": lambda: [cosserat_energy(3, 3, **COSSERAT)] * 2,
        "micromorphic": lambda: [micromorphic_energy(3, **MINDLIN)] * 2,
        "microcracked": lambda: [cracked_energy(3, n.tolist(), **CRACKS) for n in (m, Q @ m)],
    }[family]()
    e = value(before, U, nu, N)
    assert value(after, *turned(family, Q, U, nu, N)) == pytest.approx(e, rel=1e-12)
    w = rng.normal(size=3)
    W = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    along = {"Cosserat": w, "micromorphic": W.ravel(), "microcracked": 0 * w}[family]
    assert value(before, U + W, nu + along, N) == pytest.approx(e, rel=1e-12)
    if family != "microcracked":
        assert abs(value(before, U + W, nu, N) - e) > 1e-2
        return
    assert abs(value(before, *turned(family, Q, U, nu, N)) - e) > 1e-2  # m does not turn along
    flipped = cracked_energy(3, (-m).tolist(), **CRACKS)
    assert value(flipped, U, -nu, N * 0) == pytest.approx(value(before, U, nu, N * 0), rel=1e-12)


def test_cracks_take_strain_off(value):
    """c1 = −λs, c2 = −2μs: at constant ν the body is elastic in ε − s sym(ν⊗m)."""
    s, m = 0.3, np.array(NORMALS[3])
    c = CRACKS | {"c1": -0.8 * s, "c2": -1.8 * s, "k0": 0.0}
    energy = cracked_energy(3, m.tolist(), **c)
    U, nu = random(np.random.default_rng(2), (3, 3), 3)
    strain = lambda A: 0.4 * np.trace(A) ** 2 + 0.9 * np.sum((0.5 * (A + A.T)) ** 2)  # noqa: E731
    cracks = np.outer(nu, m)
    expected = strain(U - s * cracks) - s**2 * strain(cracks)
    assert value(energy, U, nu, np.zeros((3, 3))) == pytest.approx(expected, rel=1e-12)


def test_elastomer_is_objective_and_soft_at_its_bound(value):
    """A rotation with the director is free; the relaxed shear modulus is μ − D2²/(4D1)."""
    for axis in range(3):
        energy = _elastomer(axis, **RUBBER)
        across = [i for i in range(3) if i != axis]
        w = np.array([0.3, -0.2, 0.5])
        W = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        assert abs(value(energy, W, W[across, axis], np.zeros((2, 3)))) < 1e-15
        U = np.zeros((3, 3))
        U[across[0], axis] = U[axis, across[0]] = 0.5  # shear 1, no rotation
        tried = [value(energy, U, [x, 0.0], np.zeros((2, 3))) for x in (0.0, 0.5, 1.0)]
        a, b, c = np.polyfit((0.0, 0.5, 1.0), tried, 2)
        assert 2 * (c - b**2 / (4 * a)) == pytest.approx(0.9 - 0.49 / 2.0, rel=1e-12)
        assert -b / (2 * a) == pytest.approx(0.7 / 0.5 * 0.5, rel=1e-12)


def test_other_refusals():
    """Dimensions, normals, axes; Mindlin's bar and the director name their own constants."""
    for bad in ({"d": 4}, {"d": True}, {"d": 0}):
        for make in (forms.micromorphic, forms.microcracked):
            with pytest.raises(BodyError, match="Give d=1, 2 or 3"):
                make(**bad)
    for d in (1, 4, True):
        with pytest.raises(BodyError, match="Give d=2"):
            forms.plane_cosserat(d=d)
    for normal in ((0, 0, 0), (1, 0), (math.nan, 0, 0)):
        with pytest.raises(BodyError, match="Give 3 numbers"):
            forms.microcracked(normal=normal)
    for axis in (3, True):
        with pytest.raises(BodyError, match="Give 0, 1 or 2"):
            forms.nematic_elastomer(axis=axis)
    for make, names in ((forms.mindlin_bar, "ABC"), (forms.nematic_director, ("K", "bulk"))):
        for name in names:
            make(**{name: 1e-30})
            with pytest.raises(CoercivityError, match=f"{name} > 0"):
                make(**{name: 0.0})
