"""Configuration of the documentation site; `make docs` builds the site.

The source is the whole repository, because the READMEs of all folders are part of the site. The
reference pages of commands, settings, tables and metrics are generated here, before Sphinx reads
the pages.
"""

from __future__ import annotations

import importlib.metadata
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from tests import reference_pages  # noqa: E402

reference_pages.write_pages(Path(__file__).parent / "reference" / "generated")

project = "GripMap"
author = "GripMap maintainers"
release = importlib.metadata.version("gripmap")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
root_doc = "deploy/docs/index"
include_patterns = [
    "CHANGELOG.md",
    ".github/CODE_OF_CONDUCT.md",
    "CONTRIBUTING.md",
    "SECURITY.md",
    "schemas/README.md",
    "edge_agent/**.md",
    "fleet_service/**.md",
    "deploy/**.md",
    "tests/**.md",
]
exclude_patterns = ["edge_agent/inputs/profiles/NOTICE.md"]
source_suffix = {".md": "markdown"}

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
# Links to source files lead out of the site; a test checks that the files exist.
suppress_warnings = ["myst.xref_missing"]

# Avoids duplicates: attributes in a docstring are also documented as fields.
napoleon_use_ivar = True
autodoc_typehints = "description"
autodoc_member_order = "bysource"

html_theme = "furo"
html_title = "GripMap"
html_show_sourcelink = False
