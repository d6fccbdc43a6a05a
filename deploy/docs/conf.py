"""The documentation site: the READMEs as they stand, and the pages of this folder. `make docs` builds it."""

from __future__ import annotations

import importlib.metadata

project = "GripMap"
author = "GripMap maintainers"
release = importlib.metadata.version("gripmap")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
root_doc = "deploy/docs/index"
include_patterns = [
    "*.md", "schemas/README.md", "edge_agent/**.md", "fleet_service/**.md", "deploy/**.md", "tests/**/README.md"
]  # fmt: skip
exclude_patterns = ["edge_agent/inputs/profiles/NOTICE.md"]
source_suffix = {".md": "markdown"}

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
suppress_warnings = ["myst.xref_missing"]  # links to source files and folders lead out of the site

napoleon_use_ivar = True  # attributes that a docstring explains are fields already
autodoc_typehints = "description"
autodoc_member_order = "bysource"

html_theme = "furo"
html_title = "GripMap"
html_show_sourcelink = False
