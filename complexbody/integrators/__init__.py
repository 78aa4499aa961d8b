# SPDX-License-Identifier: LGPL-3.0-or-later
"""Time integrators: what users choose, and the runs they start."""
