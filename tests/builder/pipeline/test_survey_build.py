"""A build with survey cameras without colour: contact sheet, subset of views, audit, export, scoring, card."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import rebar_depth_bench as rdb
from dataset_builder.audit import audit
from dataset_builder.export import export
from rebar_depth_bench.cli.main import main as rebar_bench
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.schema import Survey
from rebar_depth_bench.geometry.cameras import camera_centre
from tests.builder.cameras.survey_cages import column, scene
from tests.builder.catalog.scene_files import write_scene
from tests.building import RunBuild
from tests.commands import run_in_process

CAMERAS = "distances = [500, 2000]\nviews_per_distance = 4"
SIZE = ("--width", "192", "--height", "108", "--no-colour")


@pytest.mark.slow
def test_build_of_life_size_column(tmp_path: Path, run_build: RunBuild) -> None:
    path = write_scene(tmp_path, scene(column(), CAMERAS), "column.toml")
    root = tmp_path / "root"
    estimate = run_build("--out", root, "--scene", path, "--views", "4", *SIZE, "--dry-run")
    assert estimate.returncode == 0, estimate.stderr
    process = run_build("--out", root, "--scene", path, "--views", "4", *SIZE)
    assert process.returncode == 0, process.stderr

    config = open_folder(root).config("column")
    assert isinstance(config.scene.protocol, Survey)
    assert [view.view_id for view in config.views] == [f"column/{n:04d}" for n in (1, 3, 5, 7)]
    assert all((view.steel_px or 0) > 10 for view in config.views)
    assert all(view.scored_px > 20 for view in config.views[:2])  # Bars at 2 m are a pixel thick.
    for row, n in zip(rdb.load(root, "column"), (1, 3, 5, 7), strict=True):
        centre_m, aimed_m = config.scene.entry["protocol"]["stations"][n]
        np.testing.assert_allclose(camera_centre(row["left_cam_from_world"]), centre_m, atol=1e-9)
        steel_m = row["left_depth"][row["left_mask"]]
        distance_m = float(np.linalg.norm(np.subtract(centre_m, aimed_m)))
        assert 0.5 * distance_m < np.median(steel_m) < 1.5 * distance_m
    assert audit(root, depth_views=1).failures == ()
    again = run_build("--out", root, "--scene", path, "--views", "4", *SIZE)
    assert "up to date: column" in again.stdout
    assert "0.5-2 m, steel aimed at" in (root / "README.md").read_text()

    export(root, tmp_path / "export")
    assert (tmp_path / "export/column/cameras.json").is_file()
    archive, result = tmp_path / "a.zip", tmp_path / "a.json"
    for arguments in (
        ("predict", "truth", "--data", root, "--out", archive),
        ("score", archive, "--data", root, "--extended", "--json", result, "--html", tmp_path / "a.html"),
    ):
        run = run_in_process(rebar_bench, *arguments)
        assert run.returncode == 0, run.stderr
    assert json.loads(result.read_text())["tables"]["column"]["rank_error"] < 1e-6

    manifest = json.loads((root / "manifest.json").read_text())
    manifest["configs"]["column"]["scenes"][0]["protocol"]["stations"][3][0][2] += 1e-6
    (root / "manifest.json").write_text(json.dumps(manifest))
    assert [check.name for check in audit(root, depth_views=0).failures] == ["column: cameras"]
