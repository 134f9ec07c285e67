"""Sphinx configuration: `make docs`, or `sphinx-build -W docs build/docs`.

The environment variable CONGRASP_REPOSITORY is the web address of the repository, to which the
links for reading and editing a page's source lead. Without it there are none.
"""

import os
import pathlib
import sys
import tomllib

ROOT = pathlib.Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs")]

project = "congrasp"
release = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
html_title = f"congrasp {release}"
html_theme = "furo"
html_show_copyright = False
html_show_sphinx = False
html_theme_options = {}
repository = os.environ.get("CONGRASP_REPOSITORY", "").rstrip("/")
if repository:
    html_theme_options["source_edit_link"] = f"{repository}/edit/main/docs/{{filename}}"
    html_theme_options["source_view_link"] = f"{repository}/blob/main/docs/{{filename}}"
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "pages",
]
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3
copybutton_exclude = ".linenos, .gp"
autodoc_member_order = "bysource"
autodoc_typehints = "none"
autodoc_class_signature = "separated"
exclude_patterns = ["images"]
