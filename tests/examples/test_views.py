"""Examples that show a view in rerun, whose recordings are read back, and that turn stereo pairs into captures."""

from __future__ import annotations

import runpy
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import rerun.dataframe
from PIL import Image
from scipy.ndimage import binary_erosion

from rebar_depth_bench import load
from rebar_depth_bench.captures.views import open_capture
from rebar_depth_bench.geometry.cameras import is_rectified
from tests.bench.methods.predictors import load_predictor

VIEW = "lattice/0028"
METRES = 2e-6
"""Tolerance of positions, which a recording holds in float32."""

ArchiveOf = Callable[..., Path]


def view_rerun(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "examples/view_rerun.py", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def read_recording(path: Path) -> dict[str, Any]:
    """Return the lists of a recording by ``entity:component``, entities below ``world``."""
    view = rerun.dataframe.load_recording(path).view(index="log_time", contents="/world/**")
    table = view.select_static().read_all()
    return {name.removeprefix("/world/"): table.column(name)[0].as_py() for name in table.schema.names}


def world_points(row: Mapping[str, Any], depth_m: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Unproject ``pixels`` (a mask) with homogeneous coordinates and plain matrix inverses."""
    v, u = np.nonzero(pixels)
    homogeneous = np.stack([u, v, np.ones_like(u)]).astype(float)
    points_cam = np.linalg.inv(row["left_K"]) @ homogeneous * depth_m[pixels]
    points = np.linalg.inv(row["left_cam_from_world"]) @ np.vstack([points_cam, np.ones_like(u)])
    return np.asarray(points[:3].T)


@pytest.mark.slow
def test_recording_holds_truth_predictions_bars_and_cameras(
    tiny_root: Path, tiny_truth: dict[str, np.ndarray], archive_of: ArchiveOf, tmp_path: Path
) -> None:
    row = next(row for row in load(tiny_root, "lattice") if row["view_id"] == VIEW)
    depth_m, mask = row["left_depth"], row["left_mask"]
    noise = np.random.default_rng(3).uniform(0.98, 1.02, depth_m.shape)
    predicted_m = (1.3 * depth_m * noise).astype(np.float32)
    predicted_m[40:50], predicted_m[50] = np.nan, 1e30
    archives = [archive_of({**tiny_truth, VIEW: predicted_m}, "a.zip"), archive_of(tiny_truth, "b.zip")]
    out = tmp_path / "view.rrd"
    process = view_rerun(tiny_root, VIEW, *archives, "--out", out)
    assert process.returncode == 0, process.stderr
    recording = read_recording(out)

    def points(entity: str) -> np.ndarray:
        return np.array(recording[f"{entity}:Position3D"])

    near = (depth_m > 0) & (depth_m <= 1.25 * depth_m[mask].max())
    for part, pixels in (("steel", mask), ("other", near & ~mask)):
        np.testing.assert_allclose(points(f"truth/{part}"), world_points(row, depth_m, pixels), atol=METRES)
        colours = np.array(recording[f"truth/{part}:Color"])
        rgb = np.stack([colours >> 24, colours >> 16 & 255, colours >> 8 & 255], axis=1)
        np.testing.assert_array_equal(rgb, row["left_rgb"][pixels])
    valid = np.isfinite(predicted_m) & (predicted_m < 1e9)
    scored = binary_erosion(mask, np.ones((3, 3))) & np.isfinite(predicted_m)
    scale = np.median(depth_m[scored].astype(float)) / np.median(predicted_m[scored].astype(float))
    for kind, factor in (("native", 1.0), ("scaled", scale)):
        expected_m = world_points(row, factor * predicted_m.astype(float), mask & valid)
        np.testing.assert_allclose(points(rf"predictions/1\:\ test/{kind}/steel"), expected_m, atol=METRES)
    exact_m = points(r"predictions/2\:\ test/native/steel")
    np.testing.assert_allclose(exact_m, points("truth/steel"), atol=METRES)
    bars = [bar for bar in pq.read_table(tiny_root / "bars.parquet").to_pylist() if bar["scene"] == "lattice"]
    for strip, bar in zip(recording["bars:LineStrip3D"], bars, strict=True):
        np.testing.assert_allclose(strip, bar["axis"], atol=METRES)
    np.testing.assert_allclose(recording["bars:Radius"], [bar["diameter_m"] / 2 for bar in bars])
    v, u = np.nonzero(mask)
    for eye, baseline_m in (("left", 0.0), ("right", row["baseline_m"])):
        rotation = np.reshape(recording[f"{eye}:TransformMat3x3"], (3, 3)).T  # Columns first.
        points_cam = (points("truth/steel") - np.array(recording[f"{eye}:Translation3D"])) @ rotation
        projected = points_cam @ np.reshape(recording[f"{eye}:PinholeProjection"], (3, 3))
        shift_px = row["left_K"][0, 0] * baseline_m / depth_m[mask]
        # The centre of rerun's first pixel is (0.5, 0.5).
        expected_px = np.stack([u - shift_px, v], axis=1) + 0.5
        np.testing.assert_allclose(projected[:, :2] / projected[:, 2:], expected_px, atol=1e-3)
        image = np.array(recording[f"{eye}/rgb:ImageBuffer"][0], np.uint8)
        np.testing.assert_array_equal(image.reshape(row[f"{eye}_rgb"].shape), row[f"{eye}_rgb"])


@pytest.mark.slow
def test_damaged_archive_is_refused(
    tiny_root: Path, tiny_truth: dict[str, np.ndarray], archive_of: ArchiveOf, tmp_path: Path
) -> None:
    archive = archive_of(tiny_truth)
    archive.write_bytes(archive.read_bytes()[:-100])
    process = view_rerun(tiny_root, VIEW, archive, "--out", tmp_path / "view.rrd")
    assert process.returncode == 2
    assert process.stderr.startswith(f"error: {archive}: ")
    assert not (tmp_path / "view.rrd").exists()


@pytest.mark.slow
def test_disparity_becomes_depth_of_the_stated_camera(tmp_path: Path) -> None:
    """SGBM does not know the measured disparity, and finds the same depth with the camera in the file."""
    disparity_px, offset_px = 12, 31.086
    texture = np.random.default_rng(5).integers(0, 256, (25, 60, 3), np.uint8).repeat(4, 0).repeat(4, 1)
    pair = [Image.fromarray(texture[:, start : start + 200]) for start in (0, disparity_px)]
    camera = {"fx": 200.0, "cx": 90.0, "cy": 49.5, "right_cx": 90.0 + offset_px, "baseline_m": 0.2}
    measured_px = np.full((100, 200), float(disparity_px))
    measured_px[:10] = np.nan
    runpy.run_path("examples/real_stereo.py")["write"](tmp_path, "pair", *pair, measured_px, camera)
    measured_m = np.load(tmp_path / "pair-measured" / "0001.npy")
    assert measured_m[50, 100] == pytest.approx(200 * 0.2 / (disparity_px + offset_px))
    assert not measured_m[:10].any()
    views = open_capture(tmp_path / "pair")
    [row] = views.rows(*views.columns, "right_cam_from_world")
    assert is_rectified(row)
    depth_m = load_predictor("sgbm")(row)
    assert np.nanmedian(depth_m) == pytest.approx(measured_m[50, 100], rel=5e-3)
