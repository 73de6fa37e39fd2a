"""How Sphinx makes the site: ``make docs`` writes it to build/site."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS.parent), str(DOCS)]

import make_api  # noqa: E402
import make_command_line  # noqa: E402
import make_notebooks  # noqa: E402
import make_provenance  # noqa: E402

project = "sst-graph"
author = "the sst-graph developers"
extensions = [
    "myst_nb",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
]
exclude_patterns: list[str] = []

# Pages that are made here and not kept in git.
make_api.write_section_pages(DOCS / "reference" / "api")
make_command_line.write_page(DOCS / "reference" / "command-line.md")
sources = make_notebooks.sources_digest()
make_notebooks.write_pages(DOCS / "notebooks", sources)

nb_execution_mode = "cache"  # a notebook runs again when its code or the package has changed
nb_execution_cache_path = str(DOCS.parent / "build" / "notebooks" / sources)
nb_execution_raise_on_error = True
nb_execution_timeout = 300
nb_merge_streams = True

myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3
suppress_warnings = [
    "misc.highlighting_failure",  # JSON and Python with ellipses
]
nitpicky = False

napoleon_use_ivar = True  # attributes in one list, not an entry each
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # shapes, frames and units stand in the docstrings
autodoc_default_options = {"members": True}
add_module_names = False
python_display_short_literal_types = True

html_theme = "furo"
html_title = "sst-graph"
html_copy_source = False
html_show_sphinx = False
html_show_copyright = False
html_static_path = ["_static"]
html_css_files = ["site.css"]
copybutton_exclude = ".linenos, .gp, .go"
highlight_language = "text"  # of blocks that name none: commands and their output
pygments_style = "friendly"
pygments_dark_style = "github-dark"


def _formulas(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """In docstrings |r| is a length, not a substitution of reStructuredText."""
    lines[:] = [re.sub(r"(?<!\\)\|", r"\\|", line) for line in lines]


def _origin(app: Any, docname: str, source: list[str]) -> None:
    """Measured pages end with the commit of their tables."""
    if docname.startswith(make_provenance.MEASURED):
        source[0] += make_provenance.origin(DOCS / f"{docname}.md")


def setup(app: Any) -> None:
    app.connect("source-read", _origin)
    app.connect("autodoc-process-docstring", _formulas)
