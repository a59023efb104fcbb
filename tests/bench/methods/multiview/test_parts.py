"""Multi-view helpers that need no rendering: COLMAP depth maps, distorted grids and failed matching."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("cv2")
pytest.importorskip("pycolmap")

import cv2
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.geometry.cameras import ideal_K, pixel_rays
from rebar_depth_bench.geometry.rectification import PinholeGrid, pinhole_grid, pinhole_image
from rebar_depth_bench.methods.multiview.dense import read_depth_map
from rebar_depth_bench.methods.multiview.sfm import LeftImages, reconstruct

ZED_DISTORTION = np.array([-0.175286, 0.0283094, 6.68e-5, -1.50e-4, 0.0])
WIDTH, HEIGHT = 320, 180


def write_depth_map(path: Path, header: str, values: Any) -> Path:
    path.write_bytes(header.encode() + np.asarray(values, "<f4").tobytes())
    return path


def test_colmap_depth_map_is_read_row_by_row(tmp_path: Path) -> None:
    written_m = np.arange(-1, 11, dtype=np.float32).reshape(3, 4)
    read_m = read_depth_map(write_depth_map(tmp_path / "a.bin", "4&3&1&", written_m))
    assert read_m.dtype == np.float32
    assert np.isnan(read_m[0, :2]).all(), "0 and below is no depth"
    assert np.array_equal(read_m.ravel()[2:], np.arange(1, 11))


@pytest.mark.parametrize("header", ["4&3&2&", "4&2&1&", "4x3", "", "9999999&9999999&1&"])
def test_invalid_colmap_depth_map_raises(header: str, tmp_path: Path) -> None:
    with pytest.raises(MethodError, match=r"is not a COLMAP depth map: .* expected WIDTH&HEIGHT&1&"):
        read_depth_map(write_depth_map(tmp_path / "a.bin", header, np.zeros(12)))


def camera_row() -> dict[str, Any]:
    rgb = np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    K = ideal_K(WIDTH, HEIGHT)
    return {"left_rgb": rgb, "left_K": K, "left_distortion": ZED_DISTORTION}


@pytest.mark.slow
@settings(max_examples=20)
@given(st.tuples(*[st.floats(-0.3, 0.3)] * 2), st.floats(0.2, 15.0))
def test_plane_depth_is_resampled_to_distorted_grid(slant: tuple[float, float], distance_m: float) -> None:
    """A plane n . x = d has depth d / (n . ray) on either grid; a pixel takes the nearest canvas pixel."""
    row = camera_row()
    grid = pinhole_grid(row, WIDTH, HEIGHT)
    normal = np.array([*slant, 1.0])
    canvas_depth_m = distance_m / (pixel_rays(grid.K, grid.width, grid.height) @ normal)
    depth_m = grid.depth_on_left_grid(canvas_depth_m.astype(np.float32))
    expected = distance_m / (pixel_rays(row["left_K"], WIDTH, HEIGHT, ZED_DISTORTION) @ normal)
    assert depth_m.shape == (HEIGHT, WIDTH)
    assert np.abs(depth_m / expected - 1).max() < 0.005, "half a pixel of slant"


def test_undistorted_image_and_depth_are_unchanged() -> None:
    row = {**camera_row(), "left_distortion": np.zeros(5)}
    grid = pinhole_grid(row, WIDTH, HEIGHT)
    assert pinhole_image(row, grid) is row["left_rgb"]
    depth = np.ones((HEIGHT, WIDTH), np.float32)
    assert grid.depth_on_left_grid(depth) is depth


def test_distorted_image_is_resampled_to_pinhole() -> None:
    """An image drawn as a function of the viewing rays is the same function of the pinhole camera's rays."""
    row = camera_row()
    rays = pixel_rays(row["left_K"], WIDTH, HEIGHT, ZED_DISTORTION)
    row["left_rgb"] = np.repeat((127 + 120 * np.sin(9 * rays[..., :1])).astype(np.uint8), 3, axis=2)
    grid = pinhole_grid(row, WIDTH, HEIGHT)
    image = pinhole_image(row, grid).astype(float)
    expected = 127 + 120 * np.sin(9 * pixel_rays(grid.K, grid.width, grid.height)[..., :1])
    middle = (slice(15, -15), slice(25, -25))
    assert np.abs(image - expected)[middle].max() < 6


def test_unrelated_images_raise(tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    names = [f"{k}.png" for k in range(3)]
    for k, name in enumerate(names):
        noise = np.random.default_rng(k).integers(0, 256, (90, 160, 3)).astype(np.uint8)
        cv2.imwrite(str(images / name), noise)
    grid = PinholeGrid(ideal_K(160, 90), 160, 90, None)
    left_images = LeftImages(images, {name: name for name in names}, grid, {}, {})
    with pytest.raises(MethodError, match="no matching pair among 3 images"):
        reconstruct(left_images, None, tmp_path)
    assert not (tmp_path / "model").exists()
