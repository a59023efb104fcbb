"""ArUco markers that OpenCV finds in the colour pictures, against where the cameras put them.

Two things move a found corner although cameras and board are right. Pictures are stored with a tone curve, under
which white spreads over black where a pixel sees both: every black edge moves inward by the same fraction of a
pixel. And ``cv2.cornerSubPix`` finds a rounded corner inside the true one. Both act alike on all edges, so one
inset for all markers of a config is fitted, told and taken off; it can hide no error of a camera, which moves or
scales the markers' places. Measured on the lattice (1280 x 720, ideal grid, 8 samples; 640 x 360, raw grid,
4 samples): an inset of 0.51 px both times, which leaves 0.21 and 0.28 px (RMS) of the corners, and 0.07 and
0.13 px of the markers' places, the means of their four corners.

Sub-pixel windows reach 4 px from a corner, or 0.8 of a marker's module where that is less, so that they never
touch the bits inside the black frame. The detector's 0.3 modules leave 0.36 px of small markers (24 to 46 px).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.audit.views import AuditedEye
from dataset_builder.optics import Camera
from rebar_depth_bench.aruco import Corners, detected_corners_px
from rebar_depth_bench.board import MARKER_MODULES, BoardSpec, marker_corners_m
from rebar_depth_bench.cameras import project, transform

LEAST_WIDTH_PX = 24.0
"""A marker whose shorter side or width across is less, by distance or slant, is not asked for: 4 px a module."""
_FLAT_M = 0.001


@dataclass(frozen=True, eq=False)
class FoundMarkers:
    """Of one eye: how many markers ought to be found, and the found of these beside the true ones, pixels."""

    expected: int
    found_px: Float64[ndarray, "n 4 2"]
    true_px: Float64[ndarray, "n 4 2"]
    corners_m: Float64[ndarray, "n 4 3"]


def found_markers(eye: AuditedEye, board: BoardSpec) -> FoundMarkers:
    """Look for the board's markers that the eye sees whole, large and not too slanted."""
    layout = marker_corners_m(board)
    true_px = projected_corners_px(eye.camera, layout)
    expected = [marker for marker in sorted(layout) if _is_clear(eye, true_px[marker])]
    detected = detected_corners_px(eye.rgb, board.dictionary) if expected else {}
    found = [marker for marker in expected if marker in detected]
    return FoundMarkers(
        expected=len(expected),
        found_px=np.array([detected[marker] for marker in found]).reshape(-1, 4, 2),
        true_px=np.array([true_px[marker] for marker in found]).reshape(-1, 4, 2),
        corners_m=np.array([layout[marker] for marker in found]).reshape(-1, 4, 3),
    )


def projected_corners_px(camera: Camera, corners_m: Mapping[int, Float64[ndarray, "4 3"]]) -> Corners:
    """Return where a camera sees markers' corners, pixels; not a number for a marker that is not before it."""
    found = {}
    for marker, world_m in corners_m.items():
        points_cam = transform(camera.cam_from_world, world_m)
        in_front = bool((points_cam[:, 2] > 0).all())
        found[marker] = project(camera.K, points_cam, camera.distortion) if in_front else np.full((4, 2), np.nan)
    return found


def inset_directions(quads_px: Float64[ndarray, "n 4 2"]) -> Float64[ndarray, "n 4 2"]:
    """Return how a quad's corners move when each of its edges moves inward by one pixel."""
    following, before = np.roll(quads_px, -1, axis=1), np.roll(quads_px, 1, axis=1)
    middle = quads_px.mean(axis=1, keepdims=True)
    normals = np.stack([_inward(before, quads_px, middle), _inward(quads_px, following, middle)], axis=2)
    return np.asarray(np.linalg.solve(normals, np.ones((*quads_px.shape[:2], 2, 1)))[..., 0])


def _inward(
    start: Float64[ndarray, "n 4 2"], end: Float64[ndarray, "n 4 2"], middle: Float64[ndarray, "n 1 2"]
) -> Float64[ndarray, "n 4 2"]:
    """Return the unit normals of edges, towards the middle."""
    along = end - start
    normal = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    side = np.sign(((middle - start) * normal).sum(axis=-1, keepdims=True))
    return np.asarray(normal * side)


def _is_clear(eye: AuditedEye, quad_px: Float64[ndarray, "4 2"]) -> bool:
    """Return whether a marker and its quiet zone stand in the frame, large enough, with nothing before them."""
    grown = quad_px.mean(axis=0) + (quad_px - quad_px.mean(axis=0)) * (1 + 1 / MARKER_MODULES)
    size = np.array([eye.camera.width, eye.camera.height])
    if not ((grown >= 1) & (grown <= size - 2)).all() or least_width_px(quad_px) < LEAST_WIDTH_PX:
        return False
    low, high = np.floor(grown.min(axis=0)).astype(int), np.ceil(grown.max(axis=0)).astype(int) + 1
    window = (slice(low[1], high[1]), slice(low[0], high[0]))
    inside = np.zeros(eye.mask[window].shape, dtype=np.uint8)
    cv2.fillConvexPoly(inside, np.round(grown - low).astype(np.int32), 1)
    flat = ~eye.mask[window] & (np.abs(eye.points_m[window][..., 2]) < _FLAT_M) & (eye.depth_m[window] > 0)
    return bool(flat[inside > 0].all())


def least_width_px(quad_px: Float64[ndarray, "4 2"]) -> float:
    """Return the least distance of a quad's corners from the lines of the sides they are not on, pixels."""
    start, end = quad_px, np.roll(quad_px, -1, axis=0)
    along = end - start
    widths = []
    for n in range(4):
        others = quad_px[[(n + 2) % 4, (n + 3) % 4]] - start[n]
        widths += (
            np.abs(along[n, 0] * others[:, 1] - along[n, 1] * others[:, 0]) / np.linalg.norm(along[n])
        ).tolist()
    return float(min(widths))
