"""Sample dataset in the repository compared with fresh renders."""

from __future__ import annotations

from pathlib import Path

import pytest

from rebar_depth_bench.data.manifest import open_folder
from tests.building import contents
from tests.data import orbit
from tests.data.render import render, render_orbit


@pytest.mark.nightly
@pytest.mark.usefixtures("blender")
def test_sample_data_equals_fresh_render(tiny_root: Path, tmp_path: Path) -> None:
    render(tmp_path / "dataset")
    assert contents(tmp_path / "dataset") == contents(tiny_root), "run `make sample-data`"


@pytest.mark.nightly
@pytest.mark.usefixtures("blender")
def test_dataset_of_stored_images_equals_fresh_render(tiny_root: Path, tmp_path: Path) -> None:
    images = render_orbit(tmp_path / "rendered")
    assert images == {path.name: path.read_bytes() for path in orbit.IMAGES.iterdir()}, "run `make sample-data`"
    orbit.write_orbit(tmp_path / "stored", tiny_root / "meshes" / "lattice.ply")
    rendered, stored = (open_folder(tmp_path / name).digest for name in ("rendered", "stored"))
    assert stored == rendered
