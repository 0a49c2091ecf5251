# This source code is licensed under the MIT license found in the LICENSE file.
"""The documentation site: ``make docs`` builds it offline, every warning is an error.

Pages about tasks, methods, commands, rooms and modules are made from the code itself by the extensions beside this
file, into ``docs/generated`` (not committed). Tutorials are shown with the output that ``make tutorials`` left.
"""

import os
import sys
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent
sys.path[:0] = [str(ROOT), str(HERE / "extensions")]
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("COLUMNS", "100")

from torchrl_koap import __version__  # noqa: E402

project = "torchrl_koap"
copyright = "the contributors of torchrl_koap, MIT licence"  # noqa: A001 - Sphinx's name
version = release = __version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "mathml",
    "task_pages",
    "method_pages",
    "command_pages",
    "design_page",
    "time_picture",
    "tutorial_pages",
    "api_pages",
]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
exclude_patterns = ["extensions", "_static", "outputs"]
if tags.has("quick"):  # noqa: F821 - of Sphinx: `-t quick` leaves out the reference
    exclude_patterns.append("generated/api/torchrl_koap.*")
root_doc = "index"

myst_enable_extensions = ["dollarmath", "deflist", "colon_fence"]
myst_heading_anchors = 3
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings tell types, with shapes and units
napoleon_google_docstring, napoleon_numpy_docstring = True, False
napoleon_use_rtype = False
napoleon_custom_sections = ["Shape"]
suppress_warnings = ["ref.python"]  # "a, b: as for f": Sphinx takes a for the type of b, and several classes have an a
add_module_names = False
html_show_sourcelink = False
html_copy_source = False

html_theme = "furo"
html_title = f"torchrl_koap {__version__}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme_options = {"navigation_with_keys": True}
pygments_style, pygments_dark_style = "friendly", "monokai"
html_math_renderer = "mathml"
