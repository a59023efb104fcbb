"""Stereo matching and raw captures: consistency, disparity to depth, and images rectified for a method."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("cv2")

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.captures.views import open_capture
from rebar_depth_bench.geometry.cameras import pixel_rays
from rebar_depth_bench.geometry.rectification import raw_depth_m, rectified_pair
from rebar_depth_bench.methods import Method, MethodInfo
from rebar_depth_bench.methods.run import predict_views, rectifying_predictor
from rebar_depth_bench.methods.sgbm import (
    MAX_LEFT_RIGHT_DIFFERENCE_PX,
    MIN_PARALLAX_PX,
    disparity_to_depth_m,
    left_right_consistent,
    without_invisible,
)
from rebar_depth_bench.submission import SubmissionReader
from tests.bench.geometry.calibrations import SHIPPED_CALIBRATION
from tests.bench.geometry.textured_plane import HEIGHT, WIDTH, plane_depth_m, raw_row
from tests.bench.methods.predictors import load_predictor
from tests.bench.methods.stand_in_models import BASELINE_M, stereo_row

Row = dict[str, Any]
METRES = st.floats(0.1, 30)
FOCAL = st.floats(50, 3000)


def test_left_right_check_on_known_row() -> None:
    left = np.array([[0, 1, 2, 2, 3, 9, 2, -1]], np.float32)
    right = np.array([[2, 5, 2, 0, 2, 7, 0, 0]], np.float32)
    # Left column -> right column (left disparity, right disparity): 1 -> 0 (1, 2), 2 -> 0 (2, 2), 3 -> 1 (2, 5),
    # 4 -> 1 (3, 5), 5 -> outside the image, 6 -> 4 (2, 2). Columns 0 and 7 have no disparity.
    assert left_right_consistent(left, right).tolist() == [[False, True, True, False, True, False, True, False]]


@given(st.integers(1, 30), st.integers(0, 2**32 - 1))
def test_consistent_plane_is_confirmed_where_both_see_it(disparity: int, seed: int) -> None:
    half_px = MAX_LEFT_RIGHT_DIFFERENCE_PX / 2
    noise = np.random.default_rng(seed).uniform(-half_px, half_px, (2, 4, 64))
    left, right = (disparity + 1.5 + noise).astype(np.float32)
    consistent = left_right_consistent(left, right)
    assert consistent[:, disparity + 3 :].all()
    assert not consistent[:, : max(disparity - 1, 0)].any()
    assert not left_right_consistent(left, right + np.float32(3 * MAX_LEFT_RIGHT_DIFFERENCE_PX)).any()


@pytest.mark.parametrize("where", ["bar", "none"])
def test_pixels_seen_by_one_eye_have_no_depth(where: str) -> None:
    """A textured bar stands in front of a textured wall; beside its edge the wall is hidden from the right eye."""
    rng = np.random.default_rng(1)
    wall, bar = (rng.integers(0, 255, (60, 240, 3), np.uint8) for _ in range(2))
    left, right = wall[:, :200].copy(), wall[:, 8:208].copy()  # The wall has 8 px of disparity.
    if where == "bar":
        left[:, 100:120], right[:, 70:90] = bar[:, :20], bar[:, :20]  # The bar has 30 px.
    row = stereo_row(np.zeros((60, 200)), fx=700.0) | {"left_rgb": left, "right_rgb": right}
    checked, filled = (load_predictor(name)(row) for name in ("sgbm", "sgbm-filled"))
    truth_m = np.full((60, 200), 700 * BASELINE_M / 8)
    if where == "bar":
        truth_m[:, 100:120] = 700 * BASELINE_M / 30
    known = np.isfinite(checked[:, 40:])
    abs_rel = np.abs(checked[:, 40:] - truth_m[:, 40:])[known] / truth_m[:, 40:][known]
    assert np.array_equal(checked[np.isfinite(checked)], filled[np.isfinite(checked)])
    assert np.mean(known) > 0.6
    assert np.mean(abs_rel > 0.1) < 0.01
    if where == "bar":
        hidden = np.isfinite(checked[:, 80:97])  # 22 px are hidden from the right eye.
        assert hidden.mean() < 0.2
        assert np.isfinite(filled).sum() > np.isfinite(checked).sum()


def make_K(fx: float, cx: float = 0.0) -> np.ndarray:
    return np.array([[fx, 0, cx], [0, fx, 0], [0, 0, 1.0]])


@given(FOCAL, METRES, st.floats(0.02, 0.4), st.floats(-5, 5), st.floats(-5, 5))
def test_disparity_of_projected_point_gives_its_depth(
    fx: float, z_m: float, baseline_m: float, cx_left: float, cx_right: float
) -> None:
    """Project a point into both eyes and recover its depth from the difference of its columns."""
    left = np.array([fx * (x_m := 1.3) / z_m + cx_left])
    right = fx * (x_m - baseline_m) / z_m + cx_right
    disparity = np.full((1, 3000), left - right)
    visible_px = without_invisible(disparity)
    depth_m = disparity_to_depth_m(visible_px, make_K(fx, cx=cx_left), make_K(fx, cx=cx_right), baseline_m)
    columns = np.arange(3000)
    parallax = fx * baseline_m / z_m
    valid = (columns >= disparity[0]) & (disparity[0] > 0) & (parallax > MIN_PARALLAX_PX * (1 + 1e-9))
    np.testing.assert_allclose(depth_m[0, valid], z_m, rtol=1e-5)
    if abs(parallax - MIN_PARALLAX_PX) > 1e-6:
        assert np.isnan(depth_m[0, ~valid]).all()


def test_match_outside_right_image_is_nan() -> None:
    visible_px = without_invisible(np.full((1, 6), 3.0, np.float32))
    depth_m = disparity_to_depth_m(visible_px, make_K(10.0), make_K(10.0), 0.6)
    np.testing.assert_array_equal(depth_m, np.array([[np.nan] * 3 + [2.0] * 3], np.float32))
    invalid_px = without_invisible(np.array([[np.nan, -2, 0, np.inf, 0.5, 1e-9]], np.float32))
    assert np.isnan(disparity_to_depth_m(invalid_px, make_K(10.0), make_K(10.0), 0.6)).all()


@pytest.fixture(scope="module")
def dataset_row() -> Row:
    """Return a row as a dataset on the raw grid holds it."""
    return {"view_id": "capture/0001", **raw_row()}


@pytest.fixture(scope="module")
def capture(dataset_row: Row, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a ZED capture of the same images."""
    root = tmp_path_factory.mktemp("raw") / "capture"
    for eye in ("left", "right"):
        (root / eye).mkdir(parents=True)
        Image.fromarray(dataset_row[f"{eye}_rgb"]).save(root / eye / "0001.png")
    (root / "calibration.conf").write_bytes(SHIPPED_CALIBRATION.read_bytes())
    return root


@pytest.mark.slow
def test_sgbm_predicts_the_same_depth_as_on_the_raw_grid_of_a_dataset(capture: Path, dataset_row: Row) -> None:
    views = open_capture(capture)
    assert views.rectify
    sgbm = load_predictor("sgbm")
    columns = [name for name in views.columns if name in dataset_row]
    [row] = views.rows(*columns)
    assert np.array_equal(sgbm(row), sgbm({name: dataset_row[name] for name in columns}), equal_nan=True)


def test_method_that_reads_no_distortion_is_given_the_rectified_pair(dataset_row: Row) -> None:
    columns = ("left_rgb", "right_rgb", "left_K", "right_K", "baseline_m")
    given: Row = {}

    def method(row: Mapping[str, Any]) -> np.ndarray:
        given.update(row)
        height, width, _ = row["left_rgb"].shape
        return np.linspace(0.3, 0.9, height * width, dtype=np.float32).reshape(height, width)

    predictor, needed = rectifying_predictor(method, columns)
    depth_m = predictor({name: dataset_row[name] for name in ("view_id", *needed)})
    pair = rectified_pair(dataset_row)
    images = {"left_rgb": pair.left_rgb, "right_rgb": pair.right_rgb, "left_K": pair.K, "right_K": pair.K}
    expected: Row = {"view_id": "capture/0001", "baseline_m": pair.baseline_m, **images}
    assert given.keys() == expected.keys()
    assert all(np.array_equal(given[name], value) for name, value in expected.items())
    assert np.array_equal(depth_m, raw_depth_m(pair, method(given)), equal_nan=True)
    assert depth_m.shape == (HEIGHT, WIDTH)


@pytest.mark.parametrize("kind", ["scale", "affine-disparity"])
def test_values_up_to_a_shift_keep_their_value_on_the_raw_grid(kind: str, dataset_row: Row) -> None:
    columns = ("left_rgb", "right_rgb")
    predictor, needed = rectifying_predictor(
        lambda row: np.full(row["left_rgb"].shape[:2], -3.0, np.float32), columns, kind
    )
    values = predictor({name: dataset_row[name] for name in ("view_id", *needed)})
    ratio = rectified_pair(dataset_row).depth_ratio if kind == "scale" else np.ones((HEIGHT, WIDTH))
    np.testing.assert_allclose(values, -3 * ratio, rtol=1e-6)


def test_exact_depth_of_the_undistorted_image_is_exact_on_the_raw_grid(dataset_row: Row) -> None:
    """A method of one image is given it without distortion; its optical axis, and so planar depth, is the same."""

    def exact(row: Mapping[str, Any]) -> np.ndarray:
        assert set(row) == {"view_id", "left_rgb", "left_K"}
        height, width, _ = row["left_rgb"].shape
        return plane_depth_m(pixel_rays(row["left_K"], width, height)).astype(np.float32)

    predictor, needed = rectifying_predictor(exact, ("left_rgb", "left_K"))
    depth_m = predictor({name: dataset_row[name] for name in ("view_id", *needed)})
    error = np.abs(depth_m / dataset_row["depth_m"] - 1)
    assert error.max() < 1e-3  # Half of a pixel on the slope of the plane.


def test_runner_predicts_a_raw_capture_on_the_grid_of_its_images(capture: Path, tmp_path: Path) -> None:
    shapes = []

    def load() -> Any:
        def run(row: Mapping[str, Any]) -> np.ndarray:
            shapes.append(row["left_rgb"].shape)
            return np.full(row["left_rgb"].shape[:2], 0.5, np.float32)

        return run

    info = MethodInfo("own", "a test", ("left_rgb", "left_K"), False, "here", "MIT")
    archive = tmp_path / "a.zip"
    predict_views(Method(info, load), [open_capture(capture)], archive)
    with SubmissionReader(archive, open_capture(capture).expected_views()) as reader:
        assert reader.read("capture/0001").shape == (HEIGHT, WIDTH)
    [shape] = shapes
    assert shape[0] > HEIGHT
    assert shape[1] > WIDTH


@pytest.mark.parametrize("column", ["left_cam_from_world", "right_cam_from_world", "left_depth"])
def test_method_that_needs_what_rectified_images_lack_is_refused(column: str) -> None:
    with pytest.raises(MethodError, match=f"needs {column}"):
        rectifying_predictor(lambda _: np.zeros(1), ("left_rgb", column))


@pytest.mark.parametrize("depth", [np.zeros((2, 2), np.float32), np.zeros((HEIGHT, WIDTH), np.int64), None])
def test_depth_of_another_shape_or_type_is_refused(depth: Any, dataset_row: Row) -> None:
    predictor, needed = rectifying_predictor(lambda _: depth, ("left_rgb", "left_K"))
    with pytest.raises(MethodError, match=r"capture/0001, rectified: .*expected an array of floats of shape"):
        predictor({name: dataset_row[name] for name in ("view_id", *needed)})
