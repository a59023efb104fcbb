"""From a reconstruction's unit to metres: by markers of known size, or by ground truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.aruco import Corners
from rebar_depth_bench.board import BoardSpec, marker_corners_m
from rebar_depth_bench.cameras import project, transform
from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods.multiview.similarity import Similarity, similarity

LEAST_VIEWS = 3
LEAST_ANGLE_DEG = 5.0
"""A corner is triangulated from at least so many views, two of them at least so far apart in angle."""
OUTLIER_PX = 3.0
LEAST_MARKERS = 2


@dataclass(frozen=True, eq=False)
class BoardFit:
    """The similarity from a reconstruction to the board's frame, metres; the markers used, the rms left over."""

    metric: Similarity
    markers: tuple[int, ...]
    rms_m: float


def board_fit(
    detections: Mapping[str, Corners],
    cam_from_sfm: Mapping[str, Float64[ndarray, "4 4"]],
    K: Float64[ndarray, "3 3"],
    board: BoardSpec,
) -> BoardFit:
    """Lay triangulated marker corners on the board's (Umeyama). Detections are pixels, by view and marker.

    Raises ``MethodError`` where fewer than two markers can be triangulated.
    """
    layout = marker_corners_m(board)
    corners: dict[int, Float64[ndarray, "4 3"]] = {}
    for marker in layout:
        views = [name for name, found in detections.items() if marker in found and name in cam_from_sfm]
        poses = [cam_from_sfm[name] for name in views]
        found = [triangulated([detections[name][marker][k] for name in views], poses, K) for k in range(4)]
        placed = [corner for corner in found if corner is not None]
        if len(placed) == 4:
            corners[marker] = np.array(placed)
    if len(corners) < LEAST_MARKERS:
        raise MethodError(
            f"of the board's {len(layout)} markers {len(corners)} can be triangulated (each of their corners in "
            f"{LEAST_VIEWS} registered views and more), expected at least {LEAST_MARKERS}"
        )
    source = np.concatenate(list(corners.values()))
    target = np.concatenate([layout[marker] for marker in corners])
    metric = similarity(source, target)
    off_m = np.linalg.norm(metric.points(source) - target, axis=1)
    return BoardFit(metric, tuple(corners), float(np.sqrt(np.mean(off_m**2))))


def triangulated(
    pixels: Sequence[Float64[ndarray, " 2"]],
    poses: Sequence[Float64[ndarray, "4 4"]],
    K: Float64[ndarray, "3 3"],
) -> Float64[ndarray, " 3"] | None:
    """Return the point that views see at these pixels; None where they are too few or too close together.

    Linear triangulation (Hartley, Zisserman, "Multiple View Geometry", 12.2), rows divided by the depth found
    before, so that pixels are minimised; then once more without the views that are off by ``OUTLIER_PX``.
    """
    kept = list(range(len(pixels)))
    for _ in range(2):
        if not _wide([poses[k] for k in kept]):
            return None
        point = _least_squares([pixels[k] for k in kept], [poses[k] for k in kept], K)
        if point is None:
            return None
        kept = [k for k in kept if _error_px(point, pixels[k], poses[k], K) <= OUTLIER_PX]
    return point if len(kept) >= LEAST_VIEWS else None


def _wide(poses: Sequence[Float64[ndarray, "4 4"]]) -> bool:
    """Tell whether there are enough views, and two of them look in directions far enough apart."""
    if len(poses) < LEAST_VIEWS:
        return False
    axes = np.array([pose[2, :3] for pose in poses])
    return bool((axes @ axes.T).min() <= np.cos(np.radians(LEAST_ANGLE_DEG)))


def _least_squares(
    pixels: Sequence[Float64[ndarray, " 2"]],
    poses: Sequence[Float64[ndarray, "4 4"]],
    K: Float64[ndarray, "3 3"],
    steps: int = 3,
) -> Float64[ndarray, " 3"] | None:
    rows = np.array(
        [P[:2] - np.outer(pixel, P[2]) for pixel, P in zip(pixels, _projections(K, poses), strict=True)]
    )
    depth_row = np.array([pose[2] for pose in poses])
    weight = np.ones(len(poses))
    for _ in range(steps):
        system = (rows * weight[:, None, None]).reshape(-1, 4)
        point = np.linalg.lstsq(system[:, :3], -system[:, 3], rcond=None)[0]
        depths = depth_row[:, :3] @ point + depth_row[:, 3]
        if not (depths > 0).all():
            return None
        weight = 1.0 / depths
    return np.asarray(point)


def _projections(
    K: Float64[ndarray, "3 3"], poses: Sequence[Float64[ndarray, "4 4"]]
) -> list[Float64[ndarray, "3 4"]]:
    return [K @ pose[:3] for pose in poses]


def _error_px(
    point: Float64[ndarray, " 3"],
    pixel: Float64[ndarray, " 2"],
    pose: Float64[ndarray, "4 4"],
    K: Float64[ndarray, "3 3"],
) -> float:
    seen = transform(pose, point)
    return float(np.linalg.norm(project(K, seen) - pixel)) if seen[2] > 0 else np.inf
