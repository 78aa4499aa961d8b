# SPDX-License-Identifier: LGPL-3.0-or-later
"""``python -m complexbody``: the same as the command ``complexbody``."""

import sys

from complexbody.cli import main

sys.exit(main())
