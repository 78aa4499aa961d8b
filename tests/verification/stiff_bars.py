# SPDX-License-Identifier: LGPL-3.0-or-later
"""A bar whose self-action is stepped over, and a mode of it to start from."""

import dolfinx
import numpy as np

import complexbody as cb


def bar(comm, body, cells=40, length=1.0, **more):
    """A bar held at its ends in u, its self-action implicit."""
    mesh = dolfinx.mesh.create_interval(comm, cells, [0.0, length])
    return cb.Scene(mesh, body, supports=[cb.Fix("u", "boundary")],
                    **({"self_action": "implicit"} | more))  # fmt: skip


def start(share, length=1.0):
    """The mode at its widest."""
    return cb.Initial(u=lambda x: np.sin(np.pi * x[0] / length),
                      nu=lambda x: share * np.cos(np.pi * x[0] / length))  # fmt: skip
