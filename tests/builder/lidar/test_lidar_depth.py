"""Simulated scans on the left image grid: coverage, occlusion, cells; LiDAR methods and their scores."""

from __future__ import annotations

import json
import math
import sys
import tomllib
import zipfile
from dataclasses import asdict, replace
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dataset_builder.lidar import LIDAR_MOBILE, LIDAR_SURVEY, MOBILE, SURVEY, lidar_method
from rebar_depth_bench import score
from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.methods import MultiViewMethod
from rebar_depth_bench.methods.run import predict
from tests.builder.lidar.lidar_scenes import (
    HEIGHT,
    PERFECT,
    WIDTH,
    camera,
    concatenate_meshes,
    scanned_depth_m,
    wall,
)

pytestmark = pytest.mark.slow

DISTORTION = np.array([-0.175, 0.028, 6.7e-5, -1.5e-4, 0.0])
STEPS_RAD = st.floats(0.01, 0.1)


@settings(max_examples=20)
@given(st.floats(0.2, 20), STEPS_RAD, STEPS_RAD, st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.booleans())
def test_wall_depth_is_exact_and_complete_at_any_step(
    depth_m: float, across: float, up: float, right_m: float, down_m: float, distorted: bool
) -> None:
    spec = replace(PERFECT, azimuth_step_rad=across, elevation_step_rad=up, position_left_m=(right_m, down_m, 0.0))
    depths_m = scanned_depth_m(spec, wall(depth_m), camera(DISTORTION if distorted else None))
    assert np.isfinite(depths_m).all()
    assert depths_m == pytest.approx(np.full((HEIGHT, WIDTH), depth_m), rel=2e-7)


@settings(max_examples=15)
@given(st.floats(0.2, 1), st.floats(0.005, 0.05), st.floats(-0.35, 0.35), st.floats(-0.06, 0.06), st.booleans())
@example(0.2, 0.05, 0.35, -0.06, False)
@example(0.2, 0.05, -0.35, -0.06, False)
def test_slanted_wall_error_is_at_most_one_cell(
    depth_m: float, step: float, slope: float, right_m: float, distorted: bool
) -> None:
    spec = replace(PERFECT, azimuth_step_rad=step, elevation_step_rad=step, position_left_m=(right_m, -0.03, 0.0))
    view = camera(DISTORTION if distorted else None)
    scanned_m = scanned_depth_m(spec, wall(depth_m, slope=slope), view)
    x = view.rays()[..., 0]
    expected_m = depth_m / (1 - slope * x)  # z = depth + slope x z
    assert np.isfinite(scanned_m).mean() > 0.995
    cell = 1 / (1 - abs(slope) * np.abs(x).max()) * (1 + np.abs(x).max() ** 2) * step
    assert np.nanmax(np.abs(scanned_m - expected_m) / expected_m) < 1.5 * cell


def test_nearer_surface_wins_in_left_view() -> None:
    """Scan from 0.3 m to the right, where the wall behind the strip is visible, unlike from the left camera."""
    spec = replace(PERFECT, position_left_m=(0.3, 0.0, 0.0))
    strip, background = wall(1.0, -0.05, 0.05), wall(2.0)
    depths_m = scanned_depth_m(spec, concatenate_meshes(strip, background))
    x = camera().rays()[..., 0]
    on_strip = np.abs(x) < 0.05 - 0.011  # away from the edge by more than a cell
    assert depths_m[on_strip] == pytest.approx(np.ones(on_strip.sum()), rel=1e-6)
    # On the wall, the strip occludes x from 2 (-0.05 - 0.3) + 0.3 to 2 (0.05 - 0.3) + 0.3 for the scanner.
    shadow = (x > -0.4 / 2 + 0.011) & (x < -0.2 / 2 - 0.011)
    assert shadow.any()
    assert np.isnan(depths_m[shadow]).all()
    free = (x > 0.05 + 0.011) & np.isfinite(depths_m)
    assert depths_m[free] == pytest.approx(np.full(free.sum(), 2.0), rel=1e-6)


def test_single_column_of_beams_fills_only_its_cell() -> None:
    """Scan a strip that is hit by a single column of beams: it is as wide as the cell of that column."""
    step = 0.04
    spec = replace(PERFECT, azimuth_step_rad=step, elevation_step_rad=step, position_left_m=(0.0, 0.0, 0.0))
    middle = math.tan(step / 2)
    depths_m = scanned_depth_m(spec, wall(1.0, middle - 0.002, middle + 0.002))
    azimuth = np.arctan(camera().rays()[0, :, 0])
    in_cell = (azimuth >= 0) & (azimuth < step)
    assert in_cell.sum() == 1
    assert np.array_equal(np.isfinite(depths_m), np.broadcast_to(in_cell, depths_m.shape))
    missed_m = scanned_depth_m(spec, wall(1.0, middle + 0.002, middle + 0.006))
    assert not np.isfinite(missed_m).any()


def test_cell_extends_only_into_empty_cells() -> None:
    step, near_m = 0.095, 0.15
    spec = replace(PERFECT, azimuth_step_rad=step, elevation_step_rad=step)
    edge_m = near_m * math.tan(step)  # boundary between two columns of cells
    depths_m = scanned_depth_m(spec, concatenate_meshes(wall(near_m, right_m=edge_m), wall(0.25)))
    azimuth = np.arctan(camera().rays()[..., 0])  # The scanner is above the camera: same azimuths.
    beyond = azimuth >= step
    assert azimuth[beyond].min() < step + 0.06 / near_m * step / 2, "no pixel that a cell could reach"
    assert depths_m[~beyond] == pytest.approx(near_m, rel=1e-6)
    assert depths_m[beyond] == pytest.approx(0.25, rel=1e-6)


ENTRY_POINT_GROUP = "rebar_depth_bench.methods"
NEAR_SPEC = replace(
    SURVEY,
    azimuth_step_rad=8 * SURVEY.azimuth_step_rad,
    elevation_step_rad=8 * SURVEY.elevation_step_rad,
    min_range_m=0.1,
)
NEAR_METHOD = lidar_method("near", NEAR_SPEC, "one that measures close by, coarse as the tiny pictures are")


def predictions(archive: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(archive) as source:
        return {name: source.read(name) for name in source.namelist() if name != "submission.json"}


@pytest.mark.parametrize("method", [LIDAR_SURVEY, LIDAR_MOBILE])
def test_entry_points_are_the_methods(method: MultiViewMethod) -> None:
    pyproject = tomllib.loads(Path("pyproject.toml").read_text())
    value = pyproject["project"]["entry-points"][ENTRY_POINT_GROUP][method.info.name]
    assert EntryPoint(method.info.name, value, ENTRY_POINT_GROUP).load() is method


def test_missing_embreex_names_pip_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "embreex", None)
    with pytest.raises(MethodError, match=r"lidar-survey requires embreex .*pip install '\.\[build\]'"):
        LIDAR_SURVEY.check(None)  # type: ignore[arg-type]


def test_lidar_predictions_of_rendered_dataset_score(tiny_root: Path, tmp_path: Path) -> None:
    archive = tmp_path / "near.zip"
    notes = predict(NEAR_METHOD, tiny_root, archive, configs=["lattice-orbit"])["lattice-orbit"].notes
    assert notes["scanner"] == asdict(NEAR_SPEC) | {
        "elevation_limits_rad": list(NEAR_SPEC.elevation_limits_rad),
        "position_left_m": [0.0, -0.06, 0.0],
    }
    with zipfile.ZipFile(archive) as source:
        submission = json.loads(source.read("submission.json"))
    assert submission["notes"]["lattice-orbit"] == notes
    table = score(archive, tiny_root).tables["lattice-orbit"]
    assert table["coverage"] > 0.7
    assert table["native.abs_rel"] < 0.2
    assert table["scale_median"] == pytest.approx(1.0, abs=0.02)
    repeated = tmp_path / "again.zip"
    predict(NEAR_METHOD, tiny_root, repeated, configs=["lattice-orbit"])
    assert predictions(repeated) == predictions(archive)


def test_lattice_is_below_minimum_range_of_mobile_lidar(tiny_root: Path, tmp_path: Path) -> None:
    archive = tmp_path / "mobile.zip"
    coarse = lidar_method("coarse", replace(MOBILE, rays_per_beam=2), "fewer rays, for the test")
    predict(coarse, tiny_root, archive, configs=["lattice-orbit"])
    table = score(archive, tiny_root).tables["lattice-orbit"]
    assert table["coverage"] == 0
    assert math.isnan(table["native.abs_rel"])
    assert not table.ranked
