"""Raw captures: methods that rectify themselves, and those that are given rectified images."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("cv2")

import numpy as np
from PIL import Image

from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.captures.views import open_capture
from rebar_depth_bench.geometry.cameras import pixel_rays
from rebar_depth_bench.geometry.rectification import raw_depth_m, rectified_pair
from rebar_depth_bench.methods import Method, MethodInfo
from rebar_depth_bench.methods.run import predict_views, rectifying_predictor
from rebar_depth_bench.submission import SubmissionReader
from tests.bench.geometry.calibrations import SHIPPED_CALIBRATION
from tests.bench.geometry.textured_plane import HEIGHT, WIDTH, plane_depth_m, raw_row
from tests.bench.methods.predictors import load_predictor

Row = dict[str, Any]


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
        return np.linspace(0.3, 0.9, row["left_rgb"][..., 0].size, dtype=np.float32).reshape(
            row["left_rgb"].shape[:2]
        )

    predictor, needed = rectifying_predictor(method, columns)
    depth_m = predictor({name: dataset_row[name] for name in ("view_id", *needed)})
    pair = rectified_pair(dataset_row)
    assert set(given) == {"view_id", *columns}
    assert given["view_id"] == "capture/0001"
    assert np.array_equal(given["left_rgb"], pair.left_rgb)
    assert np.array_equal(given["right_rgb"], pair.right_rgb)
    assert np.array_equal(given["left_K"], pair.K)
    assert np.array_equal(given["right_K"], pair.K)
    assert given["baseline_m"] == pair.baseline_m
    assert np.array_equal(depth_m, raw_depth_m(pair, method(given)), equal_nan=True)
    assert depth_m.shape == (HEIGHT, WIDTH)


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
    with pytest.raises(MethodError, match=r"capture/0001, rectified: .*expected float metres of shape"):
        predictor({name: dataset_row[name] for name in ("view_id", *needed)})
