"""LiDAR methods of the benchmark: entry points, descriptions, predictions and scores."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import tomllib
import zipfile
from dataclasses import asdict, replace
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

from dataset_builder.lidar import LIDAR_MOBILE, LIDAR_SURVEY, MOBILE, SURVEY, lidar_method
from rebar_depth_bench import load, score
from rebar_depth_bench.methods import MultiViewMethod
from rebar_depth_bench.methods.run import predict

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


def test_both_methods_are_registered_as_entry_points() -> None:
    pyproject = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text())
    entry_points = pyproject["project"]["entry-points"][ENTRY_POINT_GROUP]
    for method in (LIDAR_SURVEY, LIDAR_MOBILE):
        assert EntryPoint(method.info.name, entry_points[method.info.name], ENTRY_POINT_GROUP).load() is method


@pytest.mark.parametrize(("method", "nearest"), [(LIDAR_SURVEY, "0.6 m"), (LIDAR_MOBILE, "0.8 m")])
def test_summary_states_simulation_and_minimum_range(method: MultiViewMethod, nearest: str) -> None:
    summary = method.info.summary
    assert "reads the scene's mesh: a simulation, not a measurement on images" in summary
    assert "60 mm above the left camera, pose known exactly" in summary
    assert f"no prediction at ranges below {nearest}" in summary
    assert method.info.uses_intrinsics


@pytest.mark.slow
def test_missing_embreex_names_pip_extra() -> None:
    code = """
import sys
sys.modules["embreex"] = None
from dataset_builder.lidar import LIDAR_SURVEY
from rebar_depth_bench.base.errors import MethodError
assert not {"bpy", "trimesh", "torch", "cv2"} & set(sys.modules)
try:
    LIDAR_SURVEY.check(None)
except MethodError as error:
    print(error)
"""
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert process.stdout.strip() == (
        "lidar-survey requires embreex for ray casting: pip install 'rebar-depth-bench[build]'"
    )


@pytest.mark.slow
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
    assert table.coverage is not None
    assert table.coverage > 0.7
    assert table.native is not None
    assert table.native.abs_rel < 0.2
    assert table.scale_median == pytest.approx(1.0, abs=0.02)
    repeated = tmp_path / "again.zip"
    predict(NEAR_METHOD, tiny_root, repeated, configs=["lattice-orbit"])
    assert predictions(repeated) == predictions(archive)


@pytest.mark.slow
def test_lattice_is_below_minimum_range_of_mobile_lidar(tiny_root: Path, tmp_path: Path) -> None:
    archive = tmp_path / "mobile.zip"
    coarse = lidar_method("coarse", replace(MOBILE, rays_per_beam=2), "fewer rays, for the test")
    predict(coarse, tiny_root, archive, configs=["lattice-orbit"])
    table = score(archive, tiny_root).tables["lattice-orbit"]
    assert table.coverage == 0
    assert table.native is None
    assert not table.ranked


@pytest.mark.slow
def test_thin_noiseless_beams_match_ground_truth(tiny_root: Path, tmp_path: Path) -> None:
    """Scan with thin noiseless beams from the camera centre: the remaining error is the size of a cell."""
    thin = replace(
        SURVEY,
        divergence_sigma_rad=0.0,
        exit_sigma_m=0.0,
        rays_per_beam=1,
        noise_m=0.0,
        min_range_m=0.1,
        position_left_m=(0.0, 0.0, 0.0),
    )
    archive = tmp_path / "thin.zip"
    predict(lidar_method("thin", thin, "thin beams"), tiny_root, archive, configs=["lattice-orbit"])
    entries = predictions(archive)
    for row in load(tiny_root, "lattice-orbit", columns=["view_id", "left_depth"]):
        depth_m = np.load(io.BytesIO(entries[f"{row['view_id']}.npy"]))
        has_surface = row["left_depth"] > 0
        error = np.abs(depth_m - row["left_depth"])[has_surface] / row["left_depth"][has_surface]
        assert np.isfinite(error).mean() > 0.99
        assert np.nanmedian(error) < 1e-3
