"""Configuration of the documentation site: `make docs` builds it into build/docs."""

from __future__ import annotations

import re
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


_ENTRY = re.compile(r"{0}(, {0})*: \S".format(r"\w+( \([\w, ]*\)( \w+)?)?"))
"""Beginning of an entry for names, each with a shape and a type if it is an array."""


def _edit_docstring(
    app: Any, what: str, name: str, value: Any, options: Any, lines: list[str]
) -> None:
    """Leave out the module's text, and mark lists and code. Code is an indented block after "text:"
    and a blank line.
    """
    if what == "module":
        lines.clear()  # the page has its own introduction
    lines[:] = _with_lists(lines)
    for i in range(len(lines) - 2):
        plain = lines[i].endswith(":") and not lines[i].endswith("::")
        if plain and not lines[i + 1].strip() and lines[i + 2].startswith("    "):
            lines[i] += ":"


def _with_lists(lines: list[str]) -> list[str]:
    """Make a bulleted list of each paragraph of lines such as "v_mps: speed", as docstrings have
    them for parameters and fields; lines that continue one are indented."""
    found: list[str] = []
    in_list = False
    for i, line in enumerate(lines):
        starts = _ENTRY.match(line)
        if not line.strip():
            in_list = False
        elif starts and (in_list or i == 0 or not lines[i - 1].strip()):
            in_list = True
            line = f"- {line}"
        elif in_list:
            line = f"  {line.strip()}"
        found.append(line)
    return found


def setup(app: Any) -> None:
    """Register the change."""
    app.connect("autodoc-process-docstring", _edit_docstring)
