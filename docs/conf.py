"""Settings of Sphinx, for ``make docs``.

The source folder is the repository, so that links between its pages work here and on code hosting sites alike.
"""

from __future__ import annotations

import os
import sys
from importlib import metadata
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]
sys.path.insert(0, str(REPOSITORY))
# The notebooks read a small dataset, and find the commands of this environment.
os.environ.setdefault("REBAR_NOTEBOOK_DATA", str(REPOSITORY / "tests" / "data" / "tiny"))
os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])

project = "rebar-depth-bench"
author = "The rebar-depth-bench authors"
release = metadata.version("rebar-depth-bench")
root_doc = "docs/index"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
include_patterns = [
    "docs/**.md",
    "docs/**.ipynb",
    "cards/BENCHMARK.md",
    "deploy/README.md",
    "examples/space/README.md",
    "*.md",
]
exclude_patterns = [
    "README.md",
    ".venv*",
    "build",
    "demo-output",
    "tests",
    "**/.ipynb_checkpoints",
    "**/*.egg-info",
]

# Every reference must exist; these classes belong to packages whose pages are not read without a network.
nitpicky = True
nitpick_ignore_regex = [
    ("py:.*", r"(numpy|np|torch|datasets|pandas|jaxtyping|pydantic|collections|pathlib|typing)\..*"),
    (
        "py:.*",
        r"(os\.PathLike|ndarray|Path|DataFrame|Dataset|IterableDataset|DataLoader|Tensor|optional|ExtendedResult|Declaration)",
    ),
    ("py:.*", r"rebar_depth_bench\..*"),
]

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True, "show-inheritance": True}
add_module_names = False
napoleon_google_docstring = False

myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]
nb_execution_mode = "force"
nb_execution_show_tb = True
# Progress of reading, which depends on the machine.
nb_output_stderr = "remove"
nb_execution_raise_on_error = True
nb_execution_timeout = 300

html_theme = "furo"
html_title = f"rebar-depth-bench {release}"
html_extra_path = ["index.html"]
html_show_copyright = False
html_show_sourcelink = False
html_copy_source = False
