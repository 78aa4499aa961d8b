# SPDX-License-Identifier: LGPL-3.0-or-later
"""How much of a wave an absorbing boundary sends back, against the angle of incidence.

Wave packets of each kind (P and S, of u and of ν, coupled) meet a straight absorbing boundary in
the plane; what is left of their energy once they should be gone is printed beside the exact
reflection of a plane wave. ``python benchmarks/absorbing.py [cells per wavelength]``.
"""

import sys

import numpy as np
import scipy.linalg
from mpi4py import MPI

import complexbody as cb
from complexbody import meshes
from complexbody.forms import isotropic_two_field
from complexbody.impedance import impedance
from complexbody.problem import Problem

COMM = MPI.COMM_WORLD
KINDS = ("S of ν", "S of u", "P of ν", "P of u")
WIDTH = 2.0  # of a packet, in wavelengths: exp(−(r/WIDTH)²/2)


def moduli(**constants):
    """H of the two-field body without self-action, M, and the body itself, d = 2."""
    body = isotropic_two_field(d=2, k0=1e-9, **constants)
    mesh = meshes.rectangle(MPI.COMM_SELF, (0, 0), (1, 1), (1, 1))
    H = Problem(cb.Scene(mesh, body)).hessian_samples(0)[0]
    return body, H, np.eye(4)


def acoustic(H, p, q):
    """p_j q_k H_{aj,bk}, shape (4, 4)."""
    P, Q = (np.kron(np.eye(4), np.array([*v, 0.0])[:, None]) for v in (p, q))
    return P.T @ H[:12, :12] @ Q


def exact(H, M, kind, angle):
    """Share of a plane wave's energy flux that comes back from a boundary with normal x."""
    x, y, omega = np.array([1.0, 0.0]), np.array([0.0, 1.0]), 1.0
    direction = np.array([np.cos(angle), np.sin(angle)])
    c2, modes = scipy.linalg.eigh(acoustic(H, direction, direction), M)
    incident, k = modes[:, kind], omega / np.sqrt(c2[kind]) * direction
    A, B, C = acoustic(H, x, x), acoustic(H, x, y), acoustic(H, y, y)
    w = omega * (1 + 1e-9j)
    own = k[1] ** 2 * C - w**2 * M
    left = np.block([[np.zeros((4, 4)), np.eye(4)], [-own, -k[1] * (B + B.T)]])
    right = np.block([[np.eye(4), np.zeros((4, 4))], [np.zeros((4, 4)), A]])
    kx, a = scipy.linalg.eig(left, right)
    back = kx.imag < 0
    kx, a = kx[back], a[:4, back]
    Z = impedance(H, M, np.zeros((4, 4)), np.array([1.0, 0.0, 0.0]))

    def traction(kx, a):
        return 1j * (kx * A + k[1] * B) @ a

    def flux(kx, a):
        return float((0.5 * np.conj(-1j * omega * a) @ -traction(kx, a)).real)

    every = [traction(s, v) - 1j * omega * Z @ v for s, v in zip(kx, a.T, strict=True)]
    system = np.stack(every, axis=1)
    amount = np.linalg.solve(system, -(traction(k[0], incident) - 1j * omega * Z @ incident))
    waves = [(s, v * m) for s, v, m in zip(kx, a.T, amount, strict=True) if abs(s.imag) < 1e-6]
    returned = sum(flux(s, v) for s, v in waves)
    return -returned / flux(k[0], incident)  # round-off at normal incidence


def measured(body, H, M, kind, angle, cells=16):
    """Share of a packet's energy that is left when it should be gone."""
    d = np.array([np.cos(angle), np.sin(angle)])
    c2, modes = scipy.linalg.eigh(acoustic(H, d, d), M)
    a, c, k = modes[:, kind], np.sqrt(c2[kind]), 2 * np.pi
    reach = 3.5 * WIDTH  # of what a packet has
    path = 2 * reach / d[0]
    size = np.array([2 * reach + 0.5, 2 * reach + path * d[1]])
    start = np.array([reach, reach])
    number = np.ceil(size * cells).astype(int)
    mesh = meshes.rectangle(COMM, (0.0, 0.0), size, number)
    end = size[0]

    def wave(x, rate):
        r = x[:2] - start[:, None]
        s = d @ r
        envelope = np.exp(-0.5 * (r**2).sum(axis=0) / WIDTH**2)
        if rate:  # of f(s − ct)
            return c * envelope * (k * np.sin(k * s) + s / WIDTH**2 * np.cos(k * s))
        return envelope * np.cos(k * s)

    fields = [np.outer(a[part], 1.0) for part in (slice(0, 2), slice(2, 4))]
    values = {
        name + suffix: (lambda x, f=f, rate=rate: f * wave(x, rate))
        for suffix, rate in (("", False), ("_dot", True))
        for name, f in zip(("u", "nu"), fields, strict=True)
    }
    absorbing = [cb.Absorb(where=lambda x: x[0] > end - 1e-9)]
    scene = cb.Scene(mesh, body, initial=cb.Initial(**values), absorbing=absorbing)
    books = cb.simulate(scene, cb.Synchronous(), until=path / c, progress=False).ledger
    energy = sum(books[name] for name in ("kinetic_u", "kinetic_nu", "stored"))
    return energy[-1] / energy[0]


def main():
    """Print the table."""
    cells = int(sys.argv[1]) if len(sys.argv) > 1 else 16
    body, H, M = moduli()
    print(f"{cells} cells per wavelength: energy that comes back, measured (exact)")
    print("| angle | " + " | ".join(KINDS) + " |")
    for degrees in (0, 15, 30, 45, 60, 75):
        angle, row = np.radians(degrees), []
        for kind in range(4):
            told = exact(H, M, kind, angle)
            # Near grazing a packet wide enough would need too long a strip.
            seen = f"{measured(body, H, M, kind, angle, cells):.2%} " if degrees < 75 else ""
            row.append(f"{seen}({abs(told):.2%})")
        print(f"| {degrees}° | " + " | ".join(row) + " |", flush=True)


if __name__ == "__main__":
    main()
