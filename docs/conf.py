"""How `make docs` builds the documentation: the whole repository is the source, so that links work as on a forge."""

import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "src"), str(Path(__file__).parent / "_extensions")]

import oodil  # noqa: E402

project = "oodil"
copyright = "the oodil authors"
release = oodil.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "references"]
root_doc = "docs/index"
include_patterns = ["*.md", "docs/**.md", "configs/README.md", "benchmarks/README.md"]
exclude_patterns = [".*", "build", "runs", "src", "tests"]
myst_heading_anchors = 3
myst_enable_extensions = ["colon_fence"]

default_role = "py:obj"  # `Name` in a docstring is a link where the name is documented
python_use_unqualified_type_names = True
add_module_names = False
toc_object_entries_show_parents = "hide"
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_default_options = {"members": True}
napoleon_numpy_docstring = False

highlight_language = "text"
html_theme = "furo"
html_title = f"oodil {release}"
html_copy_source = False
templates_path = ["_templates"]
html_additional_pages = {"index": "redirect.html"}
