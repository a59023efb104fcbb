"""Source data of imports, and a dataset folder with everything imported."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from dataset_builder.importing.config_import import plan_import, run_import
from tests.builder.importing import source_data as data
from tests.builder.importing.source_data import Row


@pytest.fixture(scope="module")
def rows(tiny_root: Path) -> list[Row]:
    return data.sample_rows(tiny_root)


@pytest.fixture(scope="module")
def source(rows: list[Row], tiny_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with all files; tests write their own layouts and outputs elsewhere."""
    return data.write_source(tmp_path_factory.mktemp("source"), rows, tiny_root)


@pytest.fixture
def folder(source: Path, tmp_path: Path) -> Path:
    """Return a copy of the source that a test may change."""
    return Path(shutil.copytree(source, tmp_path / "source"))


@pytest.fixture(scope="module")
def one_camera(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a dataset folder with depth and colour of one camera."""
    out = tmp_path_factory.mktemp("one-camera")
    layout = data.write_layout(source, ("left_depth", "left_rgb"), tables="")
    run_import(plan_import(layout, "mock-up"), out / "dataset")
    return out / "dataset"
