"""The site: every page of the project, the modules' docstrings, a search; no network is needed.

    python3 make.py docs     dist/docs/docs/index.html

The source folder is the checkout, so a link that works beside the sources works in the site.
"""

import os
import re
import sys
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
# The site shows docstrings and runs nothing: kernels that numba compiles when their module is
# imported would only cost seconds. Read when numba is imported.
os.environ["NUMBA_DISABLE_JIT"] = "1"

_data = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
project, release = _data["name"], _data["version"]
author = copyright = "samii-rig contributors"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.autosummary"]
root_doc = "docs/index"
include_patterns = ["docs/**", "*.md"]
exclude_patterns = ["docs/conf.py"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
myst_heading_anchors = 6
html_theme = "furo"
html_title = f"{project} {release}"
html_copy_source = False
autosummary_generate = True
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "ignore-module-all": True}
autodoc_typehints = "signature"
autodoc_preserve_defaults = True


def _as_written(*event: Any) -> None:
    """A docstring as it stands in the source: one sentence, then text in columns of its own."""
    lines = event[-1]
    text = "\n".join(lines).strip()
    first, _, rest = text.partition("\n\n")
    one = re.sub(r"([*|\\_])", r"\\\1", re.sub(r"`+([^`]*)`+", r"\1", " ".join(first.split())))
    body = ["", ".. code-block:: text", "", *(f"   {line}" for line in rest.splitlines()), ""]
    lines[:] = [one, *(body if rest else [""])]


def setup(app: Any) -> None:
    """Called by Sphinx."""
    app.connect("autodoc-process-docstring", _as_written)
