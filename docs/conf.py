"""Configuration of Sphinx: MyST pages, notebooks and the API reference, without network access."""

from __future__ import annotations

import os
import re
import sys
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
INCLUDED = {
    "README.md": "index.md",
    "ARCHITECTURE.md": "architecture.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
    "benchmarks/README.md": "measurements.md",
    "cards/BENCHMARK.md": "benchmark-card.md",
}
"""Files of the repository that are pages of the site, and the pages that include them."""

# The reference describes the code of this checkout, also where another one is installed.
sys.path.insert(0, str(ROOT))

import rebar_depth_bench  # noqa: E402

LINKED = {
    "Declaration": "rebar_depth_bench.submission.Declaration",
    **{
        name: f"rebar_depth_bench.methods.{name}"
        for name in ("Method", "MethodInfo", "MultiViewMethod", "Prepared")
    },
    **{name: f"rebar_depth_bench.{name}" for name in rebar_depth_bench.__all__ if name not in ("bars", "score")},
}
"""Full names of the objects that docstrings name; ``bars`` and ``score`` are also words of their own."""

project = "rebar-depth-bench"
author = "The rebar-depth-bench authors"
copyright = author
version = release = installed_version("rebar-depth-bench")

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
]
exclude_patterns = ["_static", "pictures"]
root_doc = "index"

myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 4

# The notebooks read the sample of the package, and find the commands of this environment.
os.environ.setdefault("REBAR_NOTEBOOK_DATA", str(ROOT / "rebar_depth_bench" / "sample"))
os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
nb_execution_mode = "force"
nb_execution_show_tb = True
nb_output_stderr = "remove"  # Progress of reading, which depends on the machine.
nb_execution_raise_on_error = True
nb_execution_timeout = 600
# Without widgets, pages need no script of another server.
nb_ipywidgets_js: dict[str, dict[str, str]] = {}

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
maximum_signature_line_length = 88
autoclass_content = "class"
python_use_unqualified_type_names = True
# Types of other packages, whose inventories would have to be downloaded.
nitpick_ignore_regex = [
    ("py:.*", rf"({package})(\..*)?")
    for package in (
        "collections",
        "datasets",
        "jaxtyping",
        "numpy",
        "os",
        "pandas",
        "pathlib",
        "pydantic",
        "torch",
        "typing",
    )
]
# Names that the annotations have only for type checkers.
nitpick_ignore = [("py:class", name) for name in ("DataFrame", "Dataset", "IterableDataset", "Path", "ndarray")]
# ``score`` also takes a folder that is open, which the interface has no function for.
nitpick_ignore += [("py:class", "rebar_depth_bench.data.manifest.DatasetFolder"), ("py:class", "DatasetFolder")]
# A result lists its extended measures with ``to_pandas("extended")``.
nitpick_ignore += [
    ("py:class", "rebar_depth_bench.extended.estimates.ExtendedResult"),
    ("py:class", "ExtendedResult"),
]

html_theme = "furo"
html_title = f"rebar-depth-bench {release}"
html_static_path = ["_static"]
html_css_files = ["pages.css"]
html_copy_source = False
html_show_sourcelink = False
templates_path: list[str] = []


def setup(app: Any) -> None:
    """Register the functions that adapt included files and docstrings."""
    app.connect("include-read", _adapt_links)
    app.connect("autodoc-process-docstring", _link_names)


def _link_names(_app: Any, _kind: str, _name: str, _value: Any, _options: Any, lines: list[str]) -> None:
    """Make links of the names of the public interface, which docstrings mark as literals."""
    for n, line in enumerate(lines):
        lines[n] = re.sub(
            r"``(\w+)``",
            lambda word: f":py:obj:`{word[1]} <{LINKED[word[1]]}>`" if word[1] in LINKED else word[0],
            line,
        )


def _adapt_links(app: Any, path: Path, _page: str, content: list[str]) -> None:
    """Change the local links of an included file, which are relative to its folder, to links of the page."""
    folder = (Path(app.srcdir) / path).resolve().parent

    def adapted(link: re.Match[str]) -> str:
        text, target, anchor = link.groups(default="")
        if not target or "://" in target:
            return link[0]
        file = (folder / target).resolve()
        if file.is_dir():  # There is no page of a folder.
            return text
        page = INCLUDED.get(file.relative_to(ROOT).as_posix())
        return f"[{text}]({page or os.path.relpath(file, app.srcdir)}{anchor})"

    content[0] = re.sub(r"(?<!!)\[([^]]*)\]\(([^)#\s]*)(#[^)\s]*)?\)", adapted, content[0])
    content[0] = re.sub(
        r"!\[([^]]*)\]\(([^):\s]+)\)",
        lambda image: f"![{image[1]}]({os.path.relpath(folder / image[2], app.srcdir)})",
        content[0],
    )
