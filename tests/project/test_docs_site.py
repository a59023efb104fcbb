"""Documentation site: ``make docs`` builds it without warnings, and its pages need nothing from other hosts."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def site(blender: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the site; a notebook renders views."""
    out = tmp_path_factory.mktemp("site") / "html"
    [command] = re.findall(r"-m sphinx (.*) build/docs$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    arguments = [sys.executable, "-m", "sphinx", *command.split(), str(out)]
    process = subprocess.run(arguments, cwd=ROOT, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr
    return out


@pytest.mark.slow
def test_site_has_all_pages_and_the_public_names(site: Path) -> None:
    pages = [path for path in (ROOT / "docs").rglob("*") if path.suffix in (".md", ".ipynb")]
    assert len(pages) > 15
    assert all((site / path.relative_to(ROOT / "docs").with_suffix(".html")).is_file() for path in pages)
    assert (site / "index.html").is_file()
    api = (site / "api.html").read_text()
    assert all(f'id="rebar_depth_bench.{name}"' in api for name in ("load", "score", "SubmissionWriter", "Result"))


@pytest.mark.slow
def test_pages_load_nothing_from_other_hosts(site: Path) -> None:
    loaded = re.compile(r"<(?:script|img|iframe|link)\b[^>]*\b(?:src|href)=\"(?:https?:)?//[^\"]*\"")
    found = {match for page in site.rglob("*.html") for match in loaded.findall(page.read_text())}
    assert not found
