"""``rebar-bench view``: recordings read back with rerun's reader, and compared with geometry computed here."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("cv2")
pytest.importorskip("rerun")

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import rerun.dataframe
from scipy.ndimage import binary_erosion

from rebar_depth_bench import load
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.data.eye_view import EyeTruth
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.reporting.colormap import ERROR_COLOURS
from rebar_depth_bench.viewing.clouds import STEEL, archive_colour, prediction_clouds, truth_clouds
from rebar_depth_bench.viewing.recording import record_view
from rebar_depth_bench.viewing.view import read_view
from tests.commands import run_in_process

VIEW = "lattice/0028"
METRES = 2e-6
"""Tolerance of positions, which a recording holds in float32."""

WriteArchive = Callable[..., Path]


@dataclass(frozen=True)
class Recording:
    """Static content of an ``.rrd`` file: ``cells`` holds the arrays of each ``entity:component``."""

    cells: Mapping[str, Any]

    def array(self, entity: str, component: str) -> np.ndarray:
        return np.array(self.cells[f"/world/{entity}:{component}"])

    def has(self, entity: str) -> bool:
        return any(name.startswith(f"/world/{entity}:") for name in self.cells)


@pytest.fixture(scope="module")
def row(tiny_root: Path) -> dict[str, Any]:
    rows = load(tiny_root, "lattice")
    return dict(next(row for row in rows if row["view_id"] == VIEW))


def view_command(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return run_in_process(main, "view", *arguments)


def recorded(path: Path, *arguments: str | Path) -> Recording:
    """Write a recording with the command, and read it with rerun."""
    process = view_command(*arguments, "--out", path)
    assert (process.returncode, process.stdout) == (0, f"{path}\n"), process.stderr
    return read_recording(path)


def read_recording(path: Path) -> Recording:
    recording = rerun.dataframe.load_recording(path)
    table = recording.view(index="log_time", contents="/world/**").select_static().read_all()
    return Recording({name: table.column(name)[0].as_py() for name in table.schema.names})


def world_points(row: Mapping[str, Any], depth_m: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Unproject ``pixels`` (a mask) with homogeneous coordinates and plain matrix inverses."""
    v, u = np.nonzero(pixels)
    homogeneous = np.stack([u, v, np.ones_like(u)]).astype(float)
    points_cam = np.linalg.inv(row["left_K"]) @ homogeneous * depth_m[pixels]
    points = np.linalg.inv(row["left_cam_from_world"]) @ np.vstack([points_cam, np.ones_like(u)])
    return np.asarray(points[:3].T)


def rgb_of(colours: np.ndarray) -> np.ndarray:
    """Return 0xRRGGBBAA as rows of red, green and blue."""
    return np.stack([colours >> 24, colours >> 16 & 255, colours >> 8 & 255], axis=1)


def test_truth_points_lie_where_pixels_are_unprojected(
    tiny_root: Path, row: dict[str, Any], tmp_path: Path
) -> None:
    recording = recorded(tmp_path / "view.rrd", tiny_root, VIEW)
    depth_m, mask = row["left_depth"], row["left_mask"]
    far = depth_m > 1.25 * depth_m[mask].max()
    other = ~mask & (depth_m > 0)
    assert (other & far).any()
    for part, pixels in (("steel", mask), ("surroundings", other & ~far), ("background", other & far)):
        points_m = recording.array(f"truth/{part}", "Position3D")
        np.testing.assert_allclose(points_m, world_points(row, depth_m, pixels), atol=METRES)
        colours = recording.array(f"truth/{part}", "Color")
        np.testing.assert_array_equal(rgb_of(colours), row["left_rgb"][pixels])


def test_predictions_are_native_and_scaled_as_protocol_does(
    tiny_root: Path,
    row: dict[str, Any],
    tiny_truth: dict[str, np.ndarray],
    archive_of: WriteArchive,
    tmp_path: Path,
) -> None:
    depth_m, mask = row["left_depth"], row["left_mask"]
    rng = np.random.default_rng(3)
    predicted_m = (1.3 * depth_m * rng.uniform(0.98, 1.02, depth_m.shape)).astype(np.float32)
    predicted_m[40:50] = np.nan
    archives = [
        archive_of({**tiny_truth, VIEW: prediction}, name)
        for name, prediction in (("a.zip", predicted_m), ("b.zip", depth_m))
    ]
    recording = recorded(tmp_path / "view.rrd", tiny_root, VIEW, *archives)
    scored = binary_erosion(mask, np.ones((3, 3))) & np.isfinite(predicted_m)
    scale = np.median(depth_m[scored].astype(float)) / np.median(predicted_m[scored].astype(float))
    pixels = mask & np.isfinite(predicted_m)
    for kind, factor in (("native", 1.0), ("scaled", scale)):
        expected_m = world_points(row, factor * predicted_m.astype(float), pixels)
        found_m = recording.array(f"predictions/test/{kind}/steel", "Position3D")
        np.testing.assert_allclose(found_m, expected_m, atol=METRES)
    other_m = recording.array(r"predictions/test\ \(2\)/native/steel", "Position3D")
    np.testing.assert_allclose(other_m, world_points(row, depth_m, mask), atol=METRES)
    colours = [
        set(recording.array(rf"predictions/{name}/native/steel", "Color").tolist())
        for name in ("test", r"test\ \(2\)")
    ]
    assert [len(found) for found in colours] == [1, 1]
    assert colours[0] != colours[1]


def test_bars_are_strips_along_their_axes(tiny_root: Path, tmp_path: Path) -> None:
    recording = recorded(tmp_path / "view.rrd", tiny_root, VIEW)
    rows = [row for row in pq.read_table(tiny_root / "bars.parquet").to_pylist() if row["scene"] == "lattice"]
    strips = recording.cells["/world/bars:LineStrip3D"]
    assert len(strips) == len(rows) > 0
    for strip, bar in zip(strips, rows, strict=True):
        np.testing.assert_allclose(strip, bar["axis"], atol=METRES)
    np.testing.assert_allclose(recording.array("bars", "Radius"), [bar["diameter_m"] / 2 for bar in rows])
    ids = [int(label.split(":")[0]) for label in recording.cells["/world/bars:Text"]]
    assert ids == [bar["bar_id"] for bar in rows]


def test_cameras_project_points_to_their_pixels(tiny_root: Path, row: dict[str, Any], tmp_path: Path) -> None:
    recording = recorded(tmp_path / "view.rrd", tiny_root, VIEW)
    height, width = row["left_mask"].shape
    v, u = np.nonzero(row["left_mask"])
    points_m = recording.array("truth/steel", "Position3D")
    for eye in ("left", "right"):
        rotation = recording.array(eye, "TransformMat3x3").reshape(3, 3).T  # Columns first.
        points_cam = (points_m - recording.array(eye, "Translation3D")) @ rotation
        projected = points_cam @ recording.array(eye, "PinholeProjection").reshape(3, 3)
        pixel = projected[:, :2] / projected[:, 2:]
        shift_px = 0.0 if eye == "left" else row["left_K"][0, 0] * row["baseline_m"] / row["left_depth"][v, u]
        # The centre of rerun's first pixel is (0.5, 0.5).
        np.testing.assert_allclose(pixel, np.stack([u - shift_px, v], axis=1) + 0.5, atol=1e-3)
        assert recording.array(eye, "Resolution").tolist() == [[width, height]]
        image = np.array(recording.cells[f"/world/{eye}/rgb:ImageBuffer"][0], np.uint8)
        np.testing.assert_array_equal(image.reshape(height, width, 3), row[f"{eye}_rgb"])
    depth = np.array(recording.cells["/world/left/depth:ImageBuffer"][0], np.uint8).view(np.float32)
    np.testing.assert_array_equal(depth.reshape(height, width), row["left_depth"])
    assert recording.array("left/depth", "DepthMeter").tolist() == [1.0]


def test_points_of_raw_grid_follow_distorted_rays(tiny_root: Path, row: dict[str, Any]) -> None:
    view = read_view(open_folder(tiny_root), VIEW)
    distortion = np.array([-0.17, 0.03, 1e-3, -5e-4, 1e-3])
    camera = replace(view.left.camera, distortion=distortion)
    cloud = truth_clouds(replace(view, left=replace(view.left, camera=camera), rays=camera.rays()))[STEEL]
    pose = row["left_cam_from_world"]
    rotation, _ = cv2.Rodrigues(pose[:3, :3])
    pixels, _ = cv2.projectPoints(cloud.points_m, rotation, pose[:3, 3], row["left_K"], distortion)
    v, u = np.nonzero(row["left_mask"])
    np.testing.assert_allclose(pixels[:, 0], np.stack([u, v], axis=1), atol=1e-6)


def test_config_without_colour_is_shown_by_depth(tiny_root: Path, tmp_path: Path) -> None:
    root = tmp_path / "dataset"
    shutil.copytree(tiny_root, root)
    for shard in (root / "lattice").glob("*.parquet"):
        table = pq.read_table(shard)
        for name in ("left_rgb", "right_rgb"):
            position = table.schema.get_field_index(name)
            empty = pa.nulls(len(table), table.schema.field(name).type)
            table = table.set_column(position, table.schema.field(name), empty)
        pq.write_table(table, shard, row_group_size=1)
    manifest = json.loads((root / "manifest.json").read_text())
    manifest["configs"]["lattice"]["colour"] = None
    (root / "manifest.json").write_text(json.dumps(manifest))
    recording = recorded(tmp_path / "view.rrd", root, VIEW)
    assert recording.has("left/depth")
    assert not recording.has("left/rgb")
    assert not recording.has("right/rgb")
    assert len(set(recording.array("truth/surroundings", "Color").tolist())) > 20


def test_signed_error_colours_points_by_their_error(
    tiny_root: Path,
    row: dict[str, Any],
    tiny_truth: dict[str, np.ndarray],
    archive_of: WriteArchive,
    tmp_path: Path,
) -> None:
    predicted_m = row["left_depth"].astype(np.float64)
    predicted_m[:, 0::3] += 0.5
    predicted_m[:, 1::3] -= 0.011
    archive = archive_of({**tiny_truth, VIEW: predicted_m})
    recording = recorded(tmp_path / "view.rrd", tiny_root, VIEW, archive, "--signed-error", "10")
    colours = rgb_of(recording.array("predictions/test/native/steel", "Color"))
    column = np.nonzero(row["left_mask"])[1] % 3
    for remainder, index in ((0, 254), (1, 0), (2, 127)):  # Too far, too near, exact.
        assert (colours[column == remainder] == ERROR_COLOURS[index]).all()


def test_extreme_predictions_leave_sound_points(
    tiny_root: Path,
    row: dict[str, Any],
    tiny_truth: dict[str, np.ndarray],
    archive_of: WriteArchive,
    tmp_path: Path,
) -> None:
    predicted_m = row["left_depth"].astype(np.float64)
    extremes = (1e30, np.inf, -np.inf, np.nan, -1.0, 0.0, 1e-40)
    for index, value in enumerate(extremes):
        predicted_m[:, index::9] = value
    archive = archive_of({**tiny_truth, VIEW: predicted_m})
    recording = recorded(tmp_path / "view.rrd", tiny_root, VIEW, archive)
    for kind in ("native", "scaled"):
        assert np.isfinite(recording.array(f"predictions/test/{kind}/steel", "Position3D")).all()
    # Sound pixels, and the tiny depth, which is valid and lies at the camera.
    columns = np.nonzero(row["left_mask"])[1] % 9
    points_m = recording.array("predictions/test/native/steel", "Position3D")
    assert len(points_m) == np.count_nonzero(columns >= len(extremes) - 1)


def test_prediction_without_valid_pixel_has_no_scaled_cloud(
    tiny_root: Path, tiny_truth: dict[str, np.ndarray], archive_of: WriteArchive, tmp_path: Path
) -> None:
    archive = archive_of({**tiny_truth, VIEW: np.zeros_like(tiny_truth[VIEW])})
    recording = recorded(tmp_path / "view.rrd", tiny_root, VIEW, archive)
    assert not recording.has("predictions/test/scaled/steel")


def test_view_without_mask_and_right_camera_is_shown(tiny_root: Path, row: dict[str, Any], tmp_path: Path) -> None:
    view = read_view(open_folder(tiny_root), VIEW)
    left = EyeTruth(view.left.camera, None, view.left.depth_m, mask=None, bars=None)
    lacking = replace(view, left=left, right_camera=None, right_rgb=None, bars=())
    predicted_m = 2 * row["left_depth"]
    prediction = prediction_clouds(lacking, "double", predicted_m, archive_colour(0), None)
    (tmp_path / "view.rrd").write_bytes(record_view(lacking, [prediction]))
    recording = read_recording(tmp_path / "view.rrd")
    points_m = world_points(row, row["left_depth"], row["left_depth"] > 0)
    for entity in ("truth/steel", "predictions/double/scaled/steel"):
        np.testing.assert_allclose(recording.array(entity, "Position3D"), points_m, atol=METRES)
    assert not recording.has("right")


@pytest.mark.parametrize("view", ["lattice/0000", "pile/0000", "lattice", "", "../x", "lattice/\x1b[31m"])
def test_unknown_view_is_refused(tiny_root: Path, tmp_path: Path, view: str) -> None:
    process = view_command(tiny_root, view, "--out", tmp_path / "view.rrd")
    assert process.returncode == 2
    assert process.stderr.startswith("error: ")
    assert "\x1b" not in process.stderr
    assert not list(tmp_path.iterdir())


def test_damaged_inputs_are_refused(
    tiny_root: Path, tiny_truth: dict[str, np.ndarray], archive_of: WriteArchive, tmp_path: Path
) -> None:
    out = tmp_path / "view.rrd"
    archive = archive_of(tiny_truth)
    broken = tmp_path / "broken.zip"
    broken.write_bytes(archive.read_bytes()[:-100])
    elsewhere = archive_of({view: depth_m for view, depth_m in tiny_truth.items() if view != VIEW}, "partial.zip")
    for path in (broken, elsewhere, tmp_path / "absent.zip", tiny_root):
        process = view_command(tiny_root, VIEW, path, "--out", out)
        assert process.returncode == 2
        assert str(path) in process.stderr
    root = tmp_path / "dataset"
    shutil.copytree(tiny_root, root)
    (root / "bars.parquet").write_bytes(b"PAR1")
    assert view_command(root, VIEW, "--out", out).returncode == 2
    assert not out.exists()


def test_archive_without_the_config_is_refused(
    tiny_root: Path, tiny_truth: dict[str, np.ndarray], archive_of: WriteArchive, tmp_path: Path
) -> None:
    orbit = open_folder(tiny_root).config("lattice-orbit").view_ids[0]
    process = view_command(tiny_root, orbit, archive_of(tiny_truth), "--out", tmp_path / "view.rrd")
    assert process.returncode == 2
    assert orbit in process.stderr


@pytest.mark.parametrize("name", ["view.zip", "view", "."])
def test_output_needs_its_suffix(tiny_root: Path, tmp_path: Path, name: str) -> None:
    assert view_command(tiny_root, VIEW, "--out", tmp_path / name).returncode == 2
    assert not list(tmp_path.iterdir())


def test_missing_extra_is_named(tiny_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rebar_depth_bench.viewing.recording", None)
    process = view_command(tiny_root, VIEW, "--out", tmp_path / "view.rrd")
    assert process.returncode == 2
    assert "rebar-depth-bench[view]" in process.stderr
