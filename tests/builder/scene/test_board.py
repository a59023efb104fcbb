"""The board: markers where the layout says, found by OpenCV, not mirrored, clear of the steel."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from jaxtyping import Float64, UInt8
from numpy import ndarray

from dataset_builder.scene.board_texture import board_texture
from rebar_depth_bench.geometry.aruco_board import BoardSpec, marker_corners_m

PX_PER_M = 6000.0
FOOTPRINT_M = 0.05

BOARDS = pytest.mark.parametrize("spec", [BoardSpec(markers=6), BoardSpec(markers=12)], ids=["6", "12"])


def detected(texture: UInt8[ndarray, "h w"]) -> dict[int, Float64[ndarray, "4 2"]]:
    """Return the detector's corners by id, in pixels with centres at integers."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(texture)
    assert len(ids) == len(set(ids.ravel()))
    return {int(marker): found[0].astype(np.float64) for marker, found in zip(ids.ravel(), corners, strict=True)}


def expected_px(spec: BoardSpec, corners_m: Float64[ndarray, "4 3"]) -> Float64[ndarray, "4 2"]:
    """Map world corners to the texture: column along +x, row along -y; edges lie half a pixel off centres."""
    edge = np.stack([corners_m[:, 0] + spec.width_m / 2, spec.height_m / 2 - corners_m[:, 1]], axis=1)
    return np.asarray(edge * PX_PER_M - 0.5)


@BOARDS
def test_opencv_finds_every_marker_in_its_place(spec: BoardSpec) -> None:
    found = detected(board_texture(spec, PX_PER_M))
    layout = marker_corners_m(spec)
    assert sorted(found) == sorted(layout) == list(range(spec.markers))
    for marker_id, corners_m in layout.items():
        # The detector reports corner pixels, up to half a pixel inside the edge.
        np.testing.assert_allclose(found[marker_id], expected_px(spec, corners_m), atol=0.6)


def test_a_mirrored_board_would_not_be_found() -> None:
    mirrored = np.ascontiguousarray(board_texture(BoardSpec(), PX_PER_M)[:, ::-1])
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    _, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(mirrored)
    assert ids is None or set(ids.ravel()) != set(range(6))


@BOARDS
def test_marker_edges_are_exact_to_the_pixel(spec: BoardSpec) -> None:
    texture = board_texture(spec, PX_PER_M)
    for corners_m in marker_corners_m(spec).values():
        left, top = np.round(expected_px(spec, corners_m)[0] + 0.5).astype(int)
        side = round(spec.marker_side_m * PX_PER_M)
        module = side // 6
        marker = texture[top : top + side, left : left + side]
        frame = np.concatenate([marker[0], marker[-1], marker[:, 0], marker[:, -1]])
        assert (frame == 0).all()
        around = texture[top - module : top + side + module, left - module : left + side + module].copy()
        assert around.shape == (side + 2 * module, side + 2 * module)
        around[module:-module, module:-module] = 255
        assert (around == 255).all()


@BOARDS
def test_markers_lie_flat_on_the_sheet_and_clear_of_the_steel(spec: BoardSpec) -> None:
    for corners_m in marker_corners_m(spec).values():
        assert (corners_m[:, 2] == 0.0).all()
        assert (np.abs(corners_m[:, 0]) <= spec.width_m / 2).all()
        assert (np.abs(corners_m[:, 1]) <= spec.height_m / 2).all()
        nearest = np.abs(corners_m[:, :2]).min(axis=0) * (np.ptp(np.sign(corners_m[:, :2]), axis=0) == 0)
        assert nearest.max() > FOOTPRINT_M + 0.02
        np.testing.assert_allclose(np.linalg.norm(np.diff(corners_m, axis=0), axis=1), spec.marker_side_m)


def test_corner_order_is_opencvs() -> None:
    top_left, top_right, bottom_right, bottom_left = marker_corners_m(BoardSpec())[0]
    assert top_left[0] < top_right[0]
    assert top_left[1] > bottom_left[1]
    np.testing.assert_allclose(top_left + bottom_right, top_right + bottom_left)


def test_paper_is_mostly_white() -> None:
    texture = board_texture(BoardSpec(), PX_PER_M)
    assert texture.shape == (1782, 2520)
    assert texture.dtype == np.uint8
    assert (texture == 255).mean() > 0.85


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"markers": 7}, "6 or 12"),
        ({"dictionary": "DICT_5X5_50"}, "4 x 4"),
        ({"markers": 12, "marker_side_m": 0.084}, "quiet zone"),
    ],
)
def test_impossible_boards_say_why(change: dict[str, int], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        board_texture(replace(BoardSpec(), **change), PX_PER_M)  # type: ignore[arg-type]


def test_a_resolution_that_misses_pixel_edges_is_refused() -> None:
    with pytest.raises(ValueError, match="no pixel edge"):
        board_texture(BoardSpec(), 6001.0)
