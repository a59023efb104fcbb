"""From a reconstruction's unit to metres by markers of known size.

Metres for a reconstruction, by name in a registry: the board's markers, or ground truth.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.data.dataset import ConfigViews
from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.geometry.aruco_board import BoardSpec, marker_corners_m
from rebar_depth_bench.geometry.aruco_detection import Corners
from rebar_depth_bench.geometry.cameras import camera_centre, project, transform
from rebar_depth_bench.methods.multiview.dense import DepthReader
from rebar_depth_bench.methods.multiview.images import LeftPictures
from rebar_depth_bench.methods.multiview.pose_errors import Similarity, placed_report, scaled_report, similarity
from rebar_depth_bench.methods.multiview.sfm import Structure
from rebar_depth_bench.scoring.protocol import interior

LEAST_VIEWS = 3
LEAST_ANGLE_DEG = 5.0
"""A corner is triangulated from at least so many views, two of whose rays meet at least at this angle."""
MOST_PAIRS = 100
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
    """Return the point that views see at these pixels; None where too few of them agree, or from one direction.

    The two views whose point most others see within ``OUTLIER_PX`` choose the views that count; a camera that was
    registered on the wrong side of the scene takes no part. Linear triangulation (Hartley, Zisserman, "Multiple
    View Geometry", 12.2), rows divided by the depth found before, so that pixels are minimised.
    """
    seen = list(zip(pixels, poses, strict=True))
    kept = max((_agreeing(_point(pair, K), seen, K) for pair in _pairs(seen)), key=len, default=[])
    for _ in range(2):
        if len(kept) < LEAST_VIEWS:
            return None
        point = _point(kept, K)
        kept = _agreeing(point, seen, K)
    return point if len(kept) >= LEAST_VIEWS and _wide(point, kept) else None


_Seen = tuple[Float64[ndarray, " 2"], Float64[ndarray, "4 4"]]
"""A pixel, and the pose of the view that it is in."""


def _pairs(seen: Sequence[_Seen]) -> list[tuple[_Seen, _Seen]]:
    """Return pairs of views, ``MOST_PAIRS`` at most, spread evenly over all."""
    pairs = list(combinations(seen, 2))
    return pairs[:: max(1, len(pairs) // MOST_PAIRS)]


def _agreeing(point: Float64[ndarray, " 3"], seen: Sequence[_Seen], K: Float64[ndarray, "3 3"]) -> list[_Seen]:
    return [(pixel, pose) for pixel, pose in seen if _error_px(point, pixel, pose, K) <= OUTLIER_PX]


def _wide(point: Float64[ndarray, " 3"], seen: Sequence[_Seen]) -> bool:
    """Tell whether two of the rays that meet in the point are far enough apart."""
    rays = point - np.array([camera_centre(pose) for _, pose in seen])
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    return bool((rays @ rays.T).min() <= np.cos(np.radians(LEAST_ANGLE_DEG)))


def _point(seen: Sequence[_Seen], K: Float64[ndarray, "3 3"], steps: int = 3) -> Float64[ndarray, " 3"]:
    rows = np.array([np.outer(pixel, (K @ pose[:3])[2]) - (K @ pose[:3])[:2] for pixel, pose in seen])
    depth_rows = np.array([pose[2] for _, pose in seen])
    weight = np.ones(len(seen))
    for _ in range(steps):
        system = (rows * weight[:, None, None]).reshape(-1, 4)
        point = np.linalg.lstsq(system[:, :3], -system[:, 3], rcond=None)[0]
        depths = depth_rows[:, :3] @ point + depth_rows[:, 3]
        weight = 1 / np.maximum(np.abs(depths), np.finfo(np.float32).eps)
    return np.asarray(point)


def _error_px(
    point: Float64[ndarray, " 3"],
    pixel: Float64[ndarray, " 2"],
    pose: Float64[ndarray, "4 4"],
    K: Float64[ndarray, "3 3"],
) -> float:
    seen = transform(pose, point)
    return float(np.linalg.norm(project(K, seen) - pixel)) if seen[2] > 0 else np.inf


@dataclass(frozen=True)
class Scaled:
    """Metres per unit of the reconstruction, and what there is to tell of it: plain JSON values."""

    scale_m: float
    notes: Mapping[str, Any]


@dataclass(frozen=True)
class Anchoring:
    """``check`` raises ``MethodError`` for a config that it cannot scale."""

    check: Callable[[ConfigViews], None]
    scale: Callable[[ConfigViews, LeftPictures, Structure, Callable[[], DepthReader]], Scaled]
    """Dense depth is made when it is asked for."""


def _needs_board(views: ConfigViews) -> None:
    if views.board is None:
        raise MethodError(
            f"{views.config}: the scene has no ArUco board to take metres from; name configs that have one "
            "(--config lattice pile), or take a method whose name ends in -anchored"
        )


def _by_markers(
    views: ConfigViews, pictures: LeftPictures, structure: Structure, reader: Callable[[], DepthReader]
) -> Scaled:
    del reader
    board = views.board
    assert board is not None
    fit = board_fit(pictures.markers, structure.cam_from_sfm, pictures.grid.K, board)
    notes = {
        "scale_from": f"ArUco markers of {board.marker_side_m:g} m, triangulated",
        "markers": list(fit.markers),
        "marker_rms_mm": round(1000 * fit.rms_m, 4),
        **placed_report(structure.cam_from_sfm, pictures.cam_from_world, fit.metric),
    }
    return Scaled(fit.metric.scale, notes)


def _by_truth(
    views: ConfigViews, pictures: LeftPictures, structure: Structure, reader: Callable[[], DepthReader]
) -> Scaled:
    """Return the median over views of median(z / z_found) on the scored pixels (the paper, II.C)."""
    ratios, read = [], reader()
    for row in views.rows("left_depth", "left_mask"):
        name = pictures.names[row["view_id"]]
        if name not in structure.cam_from_sfm:
            continue
        found = pictures.grid.depth_on_left_grid(read(name))
        kept = interior(row["left_mask"]) & (row["left_depth"] > 0) & np.isfinite(found)
        if kept.any():
            ratios.append(float(np.median(row["left_depth"][kept].astype(np.float64) / found[kept])))
    if not ratios:
        raise MethodError(f"{views.config}: no registered view has depth on steel to anchor with")
    scale_m = float(np.median(ratios))
    notes = {
        "scale_from": "the median of ground truth over depth found: not metric by itself",
        "views_anchored_with": len(ratios),
        **scaled_report(structure.cam_from_sfm, pictures.cam_from_world, scale_m),
    }
    return Scaled(scale_m, notes)


ANCHORINGS: Mapping[str, Anchoring] = {
    "aruco": Anchoring(_needs_board, _by_markers),
    "anchored": Anchoring(lambda _: None, _by_truth),
}
