# SPDX-License-Identifier: LGPL-3.0-or-later
"""Compiled kernels: forces, energies, events, eigenvalues of cells."""
