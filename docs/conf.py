# SPDX-License-Identifier: LGPL-3.0-or-later
"""Sphinx's configuration: Markdown pages and the interface from docstrings (``make docs``)."""

import complexbody

project = "complexbody"
author = "the complexbody developers"
copyright = author
version = release = complexbody.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
]
myst_heading_anchors = 3
# Pages link to scripts and folders of the repository, which are no pages.
suppress_warnings = ["myst.xref_missing"]
autodoc_typehints = "description"
autodoc_member_order = "bysource"
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"complexbody {version}"
