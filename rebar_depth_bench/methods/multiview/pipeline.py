"""Multi-view pipeline: undistorted images, sparse reconstruction, metric scale, dense depth and the predictor.

The metric scale comes from board markers of known size or from ground truth. Errors of cameras and scale against
ground truth are reported beside the depth and not used to compute it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float32, Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.base.parallel import Progress
from rebar_depth_bench.data.rows import Views
from rebar_depth_bench.geometry.aruco_board import BoardSpec, marker_corners_m
from rebar_depth_bench.geometry.aruco_detection import Corners
from rebar_depth_bench.geometry.cameras import camera_centre
from rebar_depth_bench.methods.base import Prepared
from rebar_depth_bench.methods.multiview.dense import (
    DepthReader,
    patch_match_depth,
    plane_sweep_depth,
)
from rebar_depth_bench.methods.multiview.sfm import (
    CAMERA_MODEL,
    COLMAP_PIXEL_CENTRE,
    SEED,
    LeftImages,
    Poses,
    SparseReconstruction,
    camera_parameters,
    reconstruct,
    row_columns,
    write_left_images,
)
from rebar_depth_bench.scoring.protocol import interior

MIN_VIEWS = 3
"""Smallest number of views from which a marker corner is triangulated."""
MIN_RAY_ANGLE_DEG = 5.0
"""Smallest value of the largest angle between two rays to a triangulated corner."""
MAX_REPROJECTION_ERROR_PX = 3.0
"""Reprojection error up to which a view is an inlier."""
MIN_MARKERS = 2
"""Smallest number of triangulated markers."""


@dataclass(frozen=True, eq=False)
class Similarity:
    """Similarity transform ``x -> scale * rotation @ x + translation``."""

    scale: float
    rotation: Float64[ndarray, "3 3"]
    translation: Float64[ndarray, " 3"]

    def apply(self, source: Float64[ndarray, "*n 3"]) -> Float64[ndarray, "*n 3"]:
        """Return the transformed points."""
        return np.asarray(self.scale * source @ self.rotation.T + self.translation)


def fit_similarity(source: Float64[ndarray, "n 3"], target: Float64[ndarray, "n 3"]) -> Similarity:
    """Return the least-squares similarity with ``target ~ scale * rotation @ source + translation``.

    Three or more points that are not collinear are required. For coplanar points, which COLMAP's estimator
    refuses, a rotation and a reflection fit equally well; the rotation is returned.

    Source: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991.
    """
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    source_centred = source - source_mean
    u, singular_values, vt = np.linalg.svd((target - target_mean).T @ source_centred)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = u @ np.diag(signs) @ vt
    scale = float(singular_values @ signs / np.sum(source_centred**2))
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)


@dataclass(frozen=True, eq=False)
class BoardFit:
    """Similarity from a reconstruction to the board frame (metres), the marker ids used and the residual rms."""

    metric: Similarity
    markers: tuple[int, ...]
    rms_m: float


def fit_board(
    detections: Mapping[str, Corners],
    cam_from_sfm: Poses,
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

    COLMAP's robust estimator excludes views whose reprojection error exceeds ``MAX_REPROJECTION_ERROR_PX``, such
    as cameras that were registered on the wrong side of the scene.
    """
    if len(pixels) < MIN_VIEWS:
        return None
    options = pycolmap.EstimateTriangulationOptions(
        min_tri_angle=np.radians(MIN_RAY_ANGLE_DEG),
        residual_type=pycolmap.TriangulationResidualType.REPROJECTION_ERROR,
        ransac={"max_error": MAX_REPROJECTION_ERROR_PX, "random_seed": SEED},
    )
    camera = pycolmap.Camera(model=CAMERA_MODEL, params=camera_parameters(K))
    found = pycolmap.estimate_triangulation(
        np.array(pixels) + COLMAP_PIXEL_CENTRE,
        [pycolmap.Rigid3d(pose[:3]) for pose in poses],
        [camera] * len(poses),
        options,
    )
    return None if found is None or found["inliers"].sum() < MIN_VIEWS else found["xyz"].reshape(3)


def camera_errors(
    cam_from_sfm: Poses, cam_from_world: Poses, scale_m: float, metric: Similarity | None = None
) -> dict[str, Any]:
    """Return the errors of a scale (metres per unit), of camera centres and of rotations, as plain JSON values.

    Cameras are compared under ``metric``, the similarity to the board's frame, or under the best similarity to the
    true cameras, of which three or more are required. Without true poses, there is the scale alone.
    """
    if not cam_from_world:
        return {"scale_m": scale_m}
    centres = np.array([camera_centre(pose) for pose in cam_from_sfm.values()])
    true_centres_m = np.array([camera_centre(cam_from_world[name]) for name in cam_from_sfm])
    best = fit_similarity(centres, true_centres_m)
    world_from_sfm = best if metric is None else metric
    centre_errors_m = np.linalg.norm(world_from_sfm.apply(centres) - true_centres_m, axis=1)
    turns = [
        cam_from_world[name][:3, :3] @ world_from_sfm.rotation @ pose[:3, :3].T
        for name, pose in cam_from_sfm.items()
    ]
    return {
        "scale_m": scale_m,
        "scale_error_percent": round(100 * (scale_m / best.scale - 1), 4),
        "cameras_compared": "after the best similarity" if metric is None else "in the board's frame",
        "centre_error_mm": _median_and_largest(1000 * centre_errors_m),
        "rotation_error_deg": _median_and_largest(np.degrees(Rotation.from_matrix(turns).magnitude())),
    }


def _median_and_largest(errors: Float64[ndarray, " n"]) -> dict[str, float]:
    return {"median": round(float(np.median(errors)), 4), "largest": round(float(errors.max()), 4)}


_TRUTH_COLUMNS = ("left_depth", "left_mask")


def check(views: Views, name: str, *, uses_patch_match: bool, is_anchored: bool) -> None:
    """Raise ``MethodError`` if the method ``name`` cannot run here, or if the config has no board for its scale.

    Raises ``DatasetError`` if the config has no colour, or no ground truth for an anchored scale.
    """
    views.check_columns(row_columns(views), name)
    if uses_patch_match and not pycolmap.has_cuda:
        raise MethodError(
            "COLMAP's PatchMatch stereo needs CUDA, but this pycolmap was built without it: on a machine with an "
            "NVIDIA GPU, pip install pycolmap-cuda12 instead; on a CPU use sweep-aruco or sweep-anchored"
        )
    if is_anchored:
        views.check_columns(_TRUTH_COLUMNS, "a scale anchored to the ground truth")
    elif views.board is None:
        raise MethodError(
            f"{views.config}: the scene has no ArUco board to determine the scale; select configs with one "
            "(--config lattice pile), or use a method whose name ends in -anchored"
        )


def prepare(
    views: Views, work: Path, progress: Progress, *, uses_patch_match: bool, is_anchored: bool
) -> Prepared:
    """Reconstruct a config from its left views; notes compare cameras and scale with ground truth.

    Intermediate results are stored in ``work`` and reused. Views that were not registered have no prediction.
    """
    left_images = write_left_images(views, work / "images")
    reconstruction = reconstruct(left_images, views.board, work, progress)
    dense_depth = patch_match_depth if uses_patch_match else plane_sweep_depth
    if is_anchored:
        read_depth = dense_depth(left_images, reconstruction, work, progress)
        scale_m, scale_notes = _scale_from_ground_truth(views, left_images, reconstruction, read_depth)
    else:  # The scale comes first: missing markers raise an error before hours of dense matching.
        assert views.board is not None
        scale_m, scale_notes = _scale_from_markers(views.board, left_images, reconstruction)
        read_depth = dense_depth(left_images, reconstruction, work, progress)
    notes = {
        "views_registered": len(reconstruction.cam_from_sfm),
        "views": len(left_images.names),
        "sparse_points": len(reconstruction.points),
        "reprojection_px": round(reconstruction.reprojection_px, 4),
        **scale_notes,
    }
    no_depth = np.full(views.grid, np.nan, np.float32)

    def predict(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
        name = left_images.names[row["view_id"]]
        if name not in reconstruction.cam_from_sfm:
            return no_depth
        return np.asarray(left_images.grid.depth_on_left_grid(read_depth(name)) * np.float32(scale_m))

    return Prepared(predict, notes)


def _scale_from_markers(
    board: BoardSpec, left_images: LeftImages, reconstruction: SparseReconstruction
) -> tuple[float, Mapping[str, Any]]:
    """Return metres per unit of the reconstruction by the markers of the board, and notes."""
    fit = fit_board(left_images.markers, reconstruction.cam_from_sfm, left_images.grid.K, board)
    notes = {
        "scale_from": f"ArUco markers of {board.marker_side_m:g} m, triangulated",
        "markers": list(fit.markers),
        "marker_rms_mm": round(1000 * fit.rms_m, 4),
        **camera_errors(reconstruction.cam_from_sfm, left_images.cam_from_world, fit.metric.scale, fit.metric),
    }
    return fit.metric.scale, notes


def _scale_from_ground_truth(
    views: Views, left_images: LeftImages, reconstruction: SparseReconstruction, read_depth: DepthReader
) -> tuple[float, Mapping[str, Any]]:
    """Return the median over views of median(z / z_estimated) on scored pixels (the paper, II.C), and notes."""
    ratios = []
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
        **camera_errors(reconstruction.cam_from_sfm, left_images.cam_from_world, scale_m),
    }
    return scale_m, notes
