"""Metric scale of a reconstruction, from board markers of known size or from ground truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.data.rows import Views
from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.geometry.aruco_board import BoardSpec, marker_corners_m
from rebar_depth_bench.geometry.aruco_detection import Corners
from rebar_depth_bench.geometry.cameras import camera_centre, project, transform
from rebar_depth_bench.methods.multiview.dense import DepthReader
from rebar_depth_bench.methods.multiview.images import LeftImages
from rebar_depth_bench.methods.multiview.pose_errors import (
    Similarity,
    aligned_report,
    board_frame_report,
    fit_similarity,
)
from rebar_depth_bench.methods.multiview.sfm import SparseReconstruction
from rebar_depth_bench.scoring.protocol import interior

MIN_VIEWS = 3
"""Smallest number of views from which a marker corner is triangulated."""
MIN_RAY_ANGLE_DEG = 5.0
"""Smallest value of the largest angle between two rays to a triangulated corner."""
MAX_VIEW_PAIRS = 100
"""Number of view pairs tried per corner; fewer than twice as many are used."""
MAX_REPROJECTION_ERROR_PX = 3.0
"""Reprojection error up to which a view is an inlier."""
MIN_MARKERS = 2
"""Smallest number of triangulated markers."""
_TRUTH_COLUMNS = ("left_depth", "left_mask")
_TRIANGULATION_STEPS = 3
"""Number of reweighted least-squares solutions for the position of a corner."""


@dataclass(frozen=True, eq=False)
class BoardFit:
    """Similarity from a reconstruction to the board frame (metres), the marker ids used and the residual rms."""

    metric: Similarity
    markers: tuple[int, ...]
    rms_m: float


def fit_board(
    detections: Mapping[str, Corners],
    cam_from_sfm: Mapping[str, Float64[ndarray, "4 4"]],
    K: Float64[ndarray, "3 3"],
    board: BoardSpec,
) -> BoardFit:
    """Fit the similarity from triangulated marker corners to those of the board (Umeyama).

    ``detections`` are corners in pixels by image name and marker id. Markers of which a corner cannot be
    triangulated are not used. Raises ``MethodError`` if fewer than two markers can be triangulated.
    """
    layout = marker_corners_m(board)
    corners: dict[int, Float64[ndarray, "4 3"]] = {}
    for marker in layout:
        views = [
            name for name, found_markers in detections.items() if marker in found_markers and name in cam_from_sfm
        ]
        poses = [cam_from_sfm[name] for name in views]
        candidates = [triangulate([detections[name][marker][k] for name in views], poses, K) for k in range(4)]
        marker_corners = [corner for corner in candidates if corner is not None]
        if len(marker_corners) == 4:
            corners[marker] = np.array(marker_corners)
    if len(corners) < MIN_MARKERS:
        raise MethodError(
            f"{len(corners)} of the board's {len(layout)} markers can be triangulated (every corner is seen in "
            f"at least {MIN_VIEWS} registered views), expected at least {MIN_MARKERS}"
        )
    source = np.concatenate(list(corners.values()))
    target = np.concatenate([layout[marker] for marker in corners])
    metric = fit_similarity(source, target)
    residuals_m = np.linalg.norm(metric.apply(source) - target, axis=1)
    return BoardFit(metric, tuple(corners), float(np.sqrt(np.mean(residuals_m**2))))


def triangulate(
    pixels: Sequence[Float64[ndarray, " 2"]],
    poses: Sequence[Float64[ndarray, "4 4"]],
    K: Float64[ndarray, "3 3"],
) -> Float64[ndarray, " 3"] | None:
    """Return the point observed at these pixels; None if too few views agree or their rays are nearly parallel.

    The pair of views whose point has most inliers (reprojection error up to ``MAX_REPROJECTION_ERROR_PX``) selects
    the views used; cameras that were registered on the wrong side of the scene are thus excluded. Linear
    triangulation (Hartley, Zisserman, "Multiple View Geometry", 12.2), iteratively reweighted by the inverse of
    the previous depth, so that the error in pixels is minimised.
    """
    observations = list(zip(pixels, poses, strict=True))
    inliers = max(
        (_inliers(_triangulate_linear(pair, K), observations, K) for pair in _view_pairs(observations)),
        key=len,
        default=[],
    )
    for _ in range(2):
        if len(inliers) < MIN_VIEWS:
            return None
        point = _triangulate_linear(inliers, K)
        inliers = _inliers(point, observations, K)
    return point if len(inliers) >= MIN_VIEWS and _has_wide_rays(point, inliers) else None


_Observation = tuple[Float64[ndarray, " 2"], Float64[ndarray, "4 4"]]
"""Pixel of a point in a view, and the pose of that view."""


def _view_pairs(observations: Sequence[_Observation]) -> list[tuple[_Observation, _Observation]]:
    """Return pairs of observations, fewer than twice ``MAX_VIEW_PAIRS``, spread evenly over all pairs."""
    pairs = list(combinations(observations, 2))
    return pairs[:: max(1, len(pairs) // MAX_VIEW_PAIRS)]


def _inliers(
    point: Float64[ndarray, " 3"], observations: Sequence[_Observation], K: Float64[ndarray, "3 3"]
) -> list[_Observation]:
    return [
        (pixel, pose)
        for pixel, pose in observations
        if _reprojection_error_px(point, pixel, pose, K) <= MAX_REPROJECTION_ERROR_PX
    ]


def _has_wide_rays(point: Float64[ndarray, " 3"], observations: Sequence[_Observation]) -> bool:
    """Return whether two rays to the point differ by at least ``MIN_RAY_ANGLE_DEG``."""
    rays = point - np.array([camera_centre(pose) for _, pose in observations])
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    return bool((rays @ rays.T).min() <= np.cos(np.radians(MIN_RAY_ANGLE_DEG)))


def _triangulate_linear(
    observations: Sequence[_Observation], K: Float64[ndarray, "3 3"]
) -> Float64[ndarray, " 3"]:
    rows = np.array([np.outer(pixel, (K @ pose[:3])[2]) - (K @ pose[:3])[:2] for pixel, pose in observations])
    depth_rows = np.array([pose[2] for _, pose in observations])
    weight = np.ones(len(observations))
    for _ in range(_TRIANGULATION_STEPS):
        system = (rows * weight[:, None, None]).reshape(-1, 4)
        point = np.linalg.lstsq(system[:, :3], -system[:, 3], rcond=None)[0]
        depths = depth_rows[:, :3] @ point + depth_rows[:, 3]
        weight = 1 / np.maximum(np.abs(depths), np.finfo(np.float32).eps)
    return np.asarray(point)


def _reprojection_error_px(
    point: Float64[ndarray, " 3"],
    pixel: Float64[ndarray, " 2"],
    pose: Float64[ndarray, "4 4"],
    K: Float64[ndarray, "3 3"],
) -> float:
    point_cam = transform(pose, point)
    return float(np.linalg.norm(project(K, point_cam) - pixel)) if point_cam[2] > 0 else np.inf


@dataclass(frozen=True)
class MetricScale:
    """Metres per unit of the reconstruction, and notes on it as plain JSON values."""

    scale_m: float
    notes: Mapping[str, Any]


@dataclass(frozen=True)
class ScaleSource:
    """Source of metric scale; ``check`` raises ``MethodError`` for a config that it cannot scale."""

    check: Callable[[Views], None]
    scale: Callable[[Views, LeftImages, SparseReconstruction, Callable[[], DepthReader]], MetricScale]
    """Returns the scale of a reconstruction. The reader factory computes dense depth when it is first called."""


def _require_board(views: Views) -> None:
    """Raise ``MethodError`` if the config's scene has no board."""
    if views.board is None:
        raise MethodError(
            f"{views.config}: the scene has no ArUco board to determine the scale; select configs with one "
            "(--config lattice pile), or use a method whose name ends in -anchored"
        )


def _scale_from_markers(
    views: Views,
    left_images: LeftImages,
    reconstruction: SparseReconstruction,
    reader: Callable[[], DepthReader],
) -> MetricScale:
    del reader
    board = views.board
    assert board is not None
    fit = fit_board(left_images.markers, reconstruction.cam_from_sfm, left_images.grid.K, board)
    notes = {
        "scale_from": f"ArUco markers of {board.marker_side_m:g} m, triangulated",
        "markers": list(fit.markers),
        "marker_rms_mm": round(1000 * fit.rms_m, 4),
        **board_frame_report(reconstruction.cam_from_sfm, left_images.cam_from_world, fit.metric),
    }
    return MetricScale(fit.metric.scale, notes)


def _require_ground_truth(views: Views) -> None:
    """Raise ``InputError`` if the views lack depth or masks."""
    views.check_columns(_TRUTH_COLUMNS, "a scale anchored to the ground truth")


def _scale_from_ground_truth(
    views: Views,
    left_images: LeftImages,
    reconstruction: SparseReconstruction,
    reader: Callable[[], DepthReader],
) -> MetricScale:
    """Return the median over views of median(z / z_estimated) on the scored pixels (the paper, II.C)."""
    ratios, read_depth = [], reader()
    for row in views.rows(*_TRUTH_COLUMNS):
        name = left_images.names[row["view_id"]]
        if name not in reconstruction.cam_from_sfm:
            continue
        estimated = left_images.grid.depth_on_left_grid(read_depth(name))
        scored = interior(row["left_mask"]) & (row["left_depth"] > 0) & np.isfinite(estimated)
        if scored.any():
            ratios.append(float(np.median(row["left_depth"][scored].astype(np.float64) / estimated[scored])))
    if not ratios:
        raise MethodError(
            f"{views.config}: no registered view has depth on steel, expected at least one to determine the scale"
        )
    scale_m = float(np.median(ratios))
    notes = {
        "scale_from": "the median of ground truth over depth found: not metric by itself",
        "views_anchored_with": len(ratios),
        **aligned_report(reconstruction.cam_from_sfm, left_images.cam_from_world, scale_m),
    }
    return MetricScale(scale_m, notes)


SCALE_SOURCES: Mapping[str, ScaleSource] = {
    "aruco": ScaleSource(_require_board, _scale_from_markers),
    "anchored": ScaleSource(_require_ground_truth, _scale_from_ground_truth),
}
"""Sources of metric scale by the last part of a method's name."""
