"""How Sphinx builds these pages: `python -m sphinx -W --keep-going -b html docs docs/_build`.

Sphinx, since its autodoc reads the docstrings of the package itself and a reference that leads
nowhere is an error; MyST, since the pages are then Markdown, as the README is. The code of the
pages is run by `tests/test_docs.py`, which also compares what it prints.
"""

import re
from typing import Any

from dpend import __version__

project, author = "dpend", "The dpend authors"
version = release = __version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"dpend {version}"
# `name` is code in docstrings; types are told in words there.
default_role = "code"
autodoc_typehints = "none"
autodoc_preserve_defaults = True
autodoc_member_order = "bysource"
add_module_names = False
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_custom_sections = ["Source", "See also"]


def _escape(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Docstrings are plain text: |kappa|, p1*p2 and l_1 mean what they say."""
    whole = "\n".join(lines)
    parts = re.split(r"(`[^`]*`)", whole)
    parts[::2] = [re.sub(r"([|*\\]|_(?!\w))", r"\\\1", part) for part in parts[::2]]
    lines[:] = "".join(parts).split("\n")


def setup(app: Any) -> None:
    # Before napoleon, which makes fields of the sections.
    app.connect("autodoc-process-docstring", _escape, priority=100)
