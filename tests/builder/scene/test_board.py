"""ArUco board texture: marker layout, orientation and detection by OpenCV."""

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


def detect_markers_px(texture: UInt8[ndarray, "h w"]) -> dict[int, Float64[ndarray, "4 2"]]:
    """Return the detected corners by marker id, in pixels (integer pixel centres)."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    detections, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(texture)
    assert len(ids) == len(set(ids.ravel()))
    return {
        int(marker): detected[0].astype(np.float64)
        for marker, detected in zip(ids.ravel(), detections, strict=True)
    }


def expected_px(spec: BoardSpec, corners_m: Float64[ndarray, "4 3"]) -> Float64[ndarray, "4 2"]:
    """Return world corners in texture pixels: columns along +x, rows along -y, integer pixel centres."""
    edge_m = np.stack([corners_m[:, 0] + spec.width_m / 2, spec.height_m / 2 - corners_m[:, 1]], axis=1)
    return np.asarray(edge_m * PX_PER_M - 0.5)


@BOARDS
def test_opencv_detects_markers_at_layout_positions(spec: BoardSpec) -> None:
    detected = detect_markers_px(board_texture(spec, PX_PER_M))
    layout = marker_corners_m(spec)
    assert sorted(detected) == sorted(layout) == list(range(spec.markers))
    for marker_id, corners_m in layout.items():
        # The detector reports corner pixels, up to half a pixel inside the edge.
        np.testing.assert_allclose(detected[marker_id], expected_px(spec, corners_m), atol=0.6)


def test_mirrored_board_is_not_detected() -> None:
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
def test_markers_are_on_sheet_and_clear_of_steel(spec: BoardSpec) -> None:
    for corners_m in marker_corners_m(spec).values():
        assert (corners_m[:, 2] == 0.0).all()
        assert (np.abs(corners_m[:, 0]) <= spec.width_m / 2).all()
        assert (np.abs(corners_m[:, 1]) <= spec.height_m / 2).all()
        nearest_m = np.abs(corners_m[:, :2]).min(axis=0) * (np.ptp(np.sign(corners_m[:, :2]), axis=0) == 0)
        assert nearest_m.max() > FOOTPRINT_M + 0.02
        np.testing.assert_allclose(np.linalg.norm(np.diff(corners_m, axis=0), axis=1), spec.marker_side_m)


def test_corner_order_matches_opencv() -> None:
    top_left, top_right, bottom_right, bottom_left = marker_corners_m(BoardSpec())[0]
    assert top_left[0] < top_right[0]
    assert top_left[1] > bottom_left[1]
    np.testing.assert_allclose(top_left + bottom_right, top_right + bottom_left)


def test_texture_is_mostly_white() -> None:
    texture = board_texture(BoardSpec(), PX_PER_M)
    assert texture.shape == (1782, 2520)
    assert texture.dtype == np.uint8
    assert (texture == 255).mean() > 0.85


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"markers": 7}, "6 or 12"),
        ({"markers": 12, "marker_side_m": 0.084}, "quiet zone"),
    ],
)
def test_invalid_boards_are_rejected(change: dict[str, int], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        board_texture(replace(BoardSpec(), **change), PX_PER_M)  # type: ignore[arg-type]
