"""FoundationStereo's modes for disparities beyond the end of its cost volume, with stand-ins for the network."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("cv2")
pytest.importorskip("torch")

import cv2
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.geometry import rectification
from rebar_depth_bench.methods import Method, find_method
from rebar_depth_bench.methods.paper.foundation_stereo import (
    SMALL_RATIO,
    choose_passes,
    full_size_disparity_px,
)
from rebar_depth_bench.methods.paper.third_party import scaled_image
from rebar_depth_bench.methods.sgbm import largest_disparity_px, rectified_row
from tests.bench.methods import stand_in_models as stand_ins
from tests.bench.methods.predictors import load_predictor
from tests.bench.methods.stand_in_views import stereo_row

VOLUME_PX = 32
FX_BASELINE = 10.0
"""Focal length times baseline of ``wall_row``, pixels times metres."""


@pytest.fixture(autouse=True)
def site(tmp_path: Path) -> Iterator[None]:
    """Remove the stand-in packages after a test."""
    with stand_ins.stand_in_packages(tmp_path / "site"):
        yield


def wall_row(disparity_px: int, grid: tuple[int, int] = (67, 201)) -> dict[str, Any]:
    """Return a view of a textured wall at a whole disparity."""
    height, width = grid
    noise = np.random.default_rng(3).normal(size=(height, width + disparity_px, 3))
    smooth = cv2.GaussianBlur(noise, (0, 0), 2)
    texture = np.clip(128 + 50 * smooth / smooth.std(), 0, 255).astype(np.uint8)
    K = np.array([[100.0, 0, (width - 1) / 2], [0, 100.0, (height - 1) / 2], [0, 0, 1]])
    pair = {"left_rgb": texture[:, :width], "right_rgb": texture[:, disparity_px:], "left_K": K, "right_K": K}
    return stereo_row() | pair | {"baseline_m": 0.1, "right_cam_from_world": parallel_pose(0.1)}


def parallel_pose(baseline_m: float) -> np.ndarray:
    """Return the pose of the right camera beside a left one at the origin."""
    pose = np.eye(4)
    pose[0, 3] = -baseline_m
    return pose


def stereo_method(tmp_path: Path, nearest_m: float | None = None, max_disp: object = VOLUME_PX) -> Method:
    """Return the block-matching stand-in with a cost volume that ends at ``max_disp``."""
    clone = tmp_path / "clone"
    if not clone.exists():
        stand_ins.stereo_clone(clone, code=stand_ins.STEREO_MATCHER, max_disp=max_disp)
    method = find_method(f"foundation-stereo:{clone}", nearest_m=nearest_m)
    assert isinstance(method, Method)
    return method


def notes_of(method: Method, row: dict[str, Any]) -> dict[str, Any]:
    """Return the notes of a method on a row."""
    assert method.notes is not None
    return dict(method.notes(row))


@pytest.mark.parametrize(
    ("largest_px", "expected"),
    [
        (0.0, (False, 1.0)),
        (416.0, (False, 1.0)),
        (416.001, (True, 1.0)),
        (832.0, (True, 1.0)),
        (1664.0, (True, 0.5)),
    ],
)
def test_mode_at_boundaries(largest_px: float, expected: tuple[bool, float]) -> None:
    assert choose_passes(largest_px, 416) == expected
    assert choose_passes(832.001, 416)[1] < 1


@given(st.floats(0, 20_000), st.integers(1, 800), st.integers(40, 5000))
def test_first_pass_holds_largest_disparity(largest_px: float, volume_px: int, width: int) -> None:
    is_hierarchical, scale = choose_passes(largest_px, volume_px)
    ratio = SMALL_RATIO if is_hierarchical else 1.0
    width_px = max(1, int(width * scale))
    assert width_px == 1 or largest_px * width_px / width * ratio <= volume_px * (1 + 1e-9)


@pytest.mark.parametrize(
    ("nearest_m", "expected"), [(None, 100.5), (0.25, 40.0), (0.05, 200.0), (0.01, 201.0), (1000.0, 0.01)]
)
def test_largest_disparity_of_default_and_declared_distance(nearest_m: float | None, expected: float) -> None:
    rectified, pair = rectified_row(wall_row(5))
    assert pair is None
    assert largest_disparity_px(rectified, nearest_m) == pytest.approx(expected)


def test_principal_points_shift_largest_disparity() -> None:
    row = wall_row(5)
    row["right_K"] = row["left_K"] - np.array([[0, 0, 6.0], [0, 0, 0], [0, 0, 0]])
    assert largest_disparity_px(rectified_row(row)[0], 0.25) == pytest.approx(46)


def test_raw_pair_counts_in_pixels_of_rectified_row(tmp_path: Path) -> None:
    row = wall_row(5) | {"left_distortion": np.array([0.1, 0, 0, 0, 0])}
    pair = rectification.rectified_pair(row)
    assert pair.left_rgb.shape[1] != 201
    assert notes_of(stereo_method(tmp_path), row)["largest_disparity_px"] == pair.left_rgb.shape[1] / 2
    declared = notes_of(stereo_method(tmp_path, nearest_m=0.5), row)
    assert declared["largest_disparity_px"] == round(pair.K[0, 0] * 0.1 / 0.5, 1)


@pytest.mark.parametrize("grid", [(67, 201), (720, 1280), (37, 38)])
@pytest.mark.parametrize("scale", [1.0, 0.83, 0.5, 0.31])
def test_disparity_returns_to_full_size_in_place(grid: tuple[int, int], scale: float) -> None:
    """A disparity that grows over columns and rows is at most half a pixel of the smaller image away."""
    rows, columns = np.mgrid[: grid[0], : grid[1]].astype(np.float64)
    small = scaled_image(np.zeros((*grid, 3), np.uint8), scale).shape[:2]
    row_step, column_step = grid[0] / small[0], grid[1] / small[1]
    small_rows, small_columns = np.mgrid[: small[0], : small[1]]
    seen = ((small_rows + 0.5) * row_step + 2 * (small_columns + 0.5) * column_step - 1.5) / column_step
    full = full_size_disparity_px(seen.astype(np.float32), grid)
    assert full.shape == grid
    assert full.dtype == np.float32
    error = full - (rows + 2 * columns)
    assert np.abs(error).max() <= row_step / 2 + column_step + 1e-3
    assert np.abs(error.mean()) < 0.05 * (row_step + 2 * column_step)


@pytest.mark.parametrize(
    ("disparity_px", "nearest_m", "mode", "scale"),
    [
        (20, FX_BASELINE / 32, "single pass", 1.0),
        (20, None, "hierarchical", 64 / 100.5),
        (50, FX_BASELINE / 64, "hierarchical", 1.0),
        (80, None, "hierarchical", 64 / 100.5),
        (120, FX_BASELINE / 128, "hierarchical", 0.5),
    ],
)
def test_wall_beyond_cost_volume_is_found(
    disparity_px: int, nearest_m: float | None, mode: str, scale: float, tmp_path: Path
) -> None:
    """Each mode finds a wall of an image with odd sides."""
    row, method = wall_row(disparity_px), stereo_method(tmp_path, nearest_m)
    notes = notes_of(method, row)
    assert (notes["mode"], notes["scale"], notes["cost_volume_px"]) == (mode, round(scale, 4), VOLUME_PX)
    depth_m = load_predictor(method)(row)
    assert depth_m.shape == (67, 201)
    inner = depth_m[8:-8, disparity_px + 12 : -8]
    found_px = FX_BASELINE / inner
    assert np.isfinite(inner).all()
    assert np.abs(found_px - disparity_px).max() <= 0.5 / scale + 0.2


@pytest.mark.parametrize(("nearest_m", "scale"), [(None, 1.0), (1e-6, 832 / 1001)])
def test_match_outside_right_image_of_network_gives_nan(
    nearest_m: float | None, scale: float, tmp_path: Path
) -> None:
    """The stand-in returns half of the red channel, 100 px, as the disparity of the resized image.

    As in the authors' demo, its first 100 columns have no match, and thus the columns that are resized to them.
    """
    row = wall_row(5, (31, 1001))
    row["left_rgb"] = np.full_like(row["left_rgb"], 200)
    method = find_method(f"foundation-stereo:{stand_ins.stereo_clone(tmp_path / 'clone')}", nearest_m=nearest_m)
    assert isinstance(method, Method)
    assert notes_of(method, row)["scale"] == round(scale, 4)
    depth_m = load_predictor(method)(row)
    width_px = int(1001 * scale)
    has_match = (np.arange(1001) + 0.5) * width_px / 1001 >= 100
    assert np.isnan(depth_m[:, ~has_match]).all()
    np.testing.assert_allclose(depth_m[:, has_match], FX_BASELINE / (100 * 1001 / width_px), rtol=1e-6)


def test_wall_beyond_declared_range_is_not_found(tmp_path: Path) -> None:
    """The stand-in fails as a single pass does, so that the modes above are what finds the wall."""
    depth_m = load_predictor(stereo_method(tmp_path, FX_BASELINE / 32))(wall_row(50))
    assert not (np.abs(FX_BASELINE / depth_m[8:-8, 70:-8] - 50) < 5).any()


def test_declared_distance_is_part_of_method_info(tmp_path: Path) -> None:
    infos = [stereo_method(tmp_path, nearest_m).info for nearest_m in (None, 0.2, 0.2000001)]
    assert len({info.summary for info in infos}) == 3
    assert "as in the paper, nearest distance 0.2 m; weights sha256:" in infos[1].summary


@pytest.mark.parametrize("max_disp", ["0", "-416", "true", "416.0", "'416'", "[]", "null"])
def test_invalid_end_of_cost_volume_raises(max_disp: str, tmp_path: Path) -> None:
    with pytest.raises(MethodError, match=r"cfg\.yaml: max_disp is .*, expected the end of the cost volume"):
        load_predictor(stereo_method(tmp_path, max_disp=max_disp))


def test_predict_records_mode_of_each_config(
    tmp_path: Path, tiny_root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    clone, archive = stand_ins.stereo_clone(tmp_path / "theirs"), tmp_path / "out.zip"
    command = ["predict", f"foundation-stereo:{clone}", "--data", str(tiny_root), "--out", str(archive)]
    assert main([*command, "--nearest-distance", "0.12"]) == 0
    assert "lattice-orbit: mode: single pass" in capsys.readouterr().err
    with zipfile.ZipFile(archive) as entries:
        metadata = json.loads(entries.read("submission.json"))
    expected = {
        "mode": "single pass",
        "scale": 1.0,
        "largest_disparity_px": 87.5,
        "largest_disparity_from": "nearest distance 0.12 m",
        "cost_volume_px": 416,
    }
    assert metadata["notes"] == {"lattice": expected, "lattice-orbit": expected}
    assert "preparing" not in metadata["runtime"]


def test_distance_for_other_method_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["predict", "sgbm", "--data", "x", "--out", str(tmp_path / "out.zip"), "--nearest-distance", "0.2"]
    assert main(command) == 2
    assert "sgbm: has no nearest distance, expected foundation-stereo:FOLDER" in capsys.readouterr().err


@pytest.mark.parametrize("metres", ["0", "-1", "nan", "inf", "near"])
def test_invalid_distance_is_refused(metres: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["predict", "sgbm", "--data", "x", "--out", str(tmp_path / "x"), f"--nearest-distance={metres}"])
    assert "--nearest-distance" in capsys.readouterr().err
