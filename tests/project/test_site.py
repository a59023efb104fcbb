"""Documentation as a site: a build without warnings, no content of other servers, and the public interface."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

import rebar_depth_bench
from tests.project.pages import ROOT

pytestmark = pytest.mark.slow
METHOD_TYPES = ("Method", "MethodInfo", "MultiViewMethod", "Prepared", "Views", "find_method")


@pytest.fixture(scope="module")
def site(blender: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the site as ``make docs`` does, which executes the notebooks; one of them builds views."""
    [line] = [line for line in (ROOT / "Makefile").read_text().splitlines() if "-m sphinx" in line]
    out = tmp_path_factory.mktemp("site")
    options = line.split("-m sphinx ")[1].split()
    assert options[-2:] == ["docs", "build/docs"]
    command = [sys.executable, "-m", "sphinx", *options[:-1], str(out)]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    return out


def test_pages_load_nothing_from_other_servers(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > 20
    for page in pages:
        loaded = re.findall(r"<(?:script|link|img|iframe)\b[^>]*?(?:src|href)=\"([^\"]+)\"", page.read_text())
        assert [url for url in loaded if url.startswith(("http:", "https:", "//"))] == [], page.name


def test_reference_lists_the_public_interface(site: Path) -> None:
    page = (site / "api.html").read_text()
    listed = set(re.findall(r'id="(rebar_depth_bench\.[\w.]+)"', page))
    assert {f"rebar_depth_bench.{name}" for name in rebar_depth_bench.__all__} <= listed
    assert {f"rebar_depth_bench.methods.{name}" for name in METHOD_TYPES} <= listed


def test_docstrings_and_included_files_link_pages_of_the_site(site: Path) -> None:
    reference, architecture = (site / "api.html").read_text(), (site / "architecture.html").read_text()
    assert 'href="#rebar_depth_bench.DatasetError"' in reference
    assert 'href="design.html' in architecture
    assert "packages.svg" in architecture
