"""Configuration of the documentation site: `make docs` builds it into build/docs."""

from __future__ import annotations

import sys
from importlib import metadata
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

project = "cosim"
author = "the cosim contributors"
release = metadata.version("sidewalk-cosim")
extensions = ["myst_parser", "sphinx.ext.autodoc"]
html_theme = "furo"
html_title = f"cosim {release}"
html_show_copyright = False
myst_heading_anchors = 3
autodoc_inherit_docstrings = False
autodoc_preserve_defaults = True
autodoc_typehints = "none"
default_role = "code"


def _edit_docstring(
    app: Any, what: str, name: str, value: Any, options: Any, lines: list[str]
) -> None:
    """Leaves out the module's text, and marks code: an indented block after "text:" and a blank
    line."""
    if what == "module":
        lines.clear()  # the page has its own introduction
    for i in range(len(lines) - 2):
        plain = lines[i].endswith(":") and not lines[i].endswith("::")
        if plain and not lines[i + 1].strip() and lines[i + 2].startswith("    "):
            lines[i] += ":"


def setup(app: Any) -> None:
    """Registers the change."""
    app.connect("autodoc-process-docstring", _edit_docstring)
