"""Similarity transforms between point sets, and errors of reconstructed cameras and scale against ground truth.

The errors are reported beside the depth and not used to compute it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.geometry.cameras import camera_centre


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

    Three or more points that are not collinear are required. For coplanar points a rotation and a reflection fit
    equally well; the rotation is returned.
    Source: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991.
    """
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    source_centred = source - source_mean
    u, singular_values, vt = np.linalg.svd((target - target_mean).T @ source_centred)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = u @ np.diag(signs) @ vt
    scale = float(singular_values @ signs / np.sum(source_centred**2))
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)


def rotation_angle_deg(rotation: Float64[ndarray, "3 3"]) -> float:
    """Return the angle of a rotation, degrees."""
    skew = np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    return float(np.degrees(np.arctan2(np.linalg.norm(skew), np.trace(rotation) - 1)))


Poses = Mapping[str, Float64[ndarray, "4 4"]]
"""Camera poses (cam_from_...) by image name."""


def similarity_to_world(cam_from_sfm: Poses, cam_from_world: Poses) -> Similarity:
    """Return the similarity from estimated to true camera centres, metres; three or more cameras are required."""
    return fit_similarity(_centres(cam_from_sfm, cam_from_sfm), _centres(cam_from_world, cam_from_sfm))


def board_frame_report(cam_from_sfm: Poses, cam_from_world: Poses, metric: Similarity) -> dict[str, Any]:
    """Return errors of scale, camera centres and rotations under the estimated similarity to the board frame.

    Without true poses, there is the scale alone.
    """
    if not cam_from_world:
        return {"scale_m": metric.scale}
    return {
        **_scale_error(cam_from_sfm, cam_from_world, metric.scale),
        "cameras_compared": "in the board's frame",
        **_pose_errors(cam_from_sfm, cam_from_world, metric),
    }


def aligned_report(cam_from_sfm: Poses, cam_from_world: Poses, scale_m: float) -> dict[str, Any]:
    """Return the error of an estimated scale, and camera errors under the best similarity to the true cameras."""
    return {
        **_scale_error(cam_from_sfm, cam_from_world, scale_m),
        "cameras_compared": "after the best similarity",
        **_pose_errors(cam_from_sfm, cam_from_world, similarity_to_world(cam_from_sfm, cam_from_world)),
    }


def _scale_error(cam_from_sfm: Poses, cam_from_world: Poses, scale_m: float) -> dict[str, float]:
    true_m = similarity_to_world(cam_from_sfm, cam_from_world).scale
    return {"scale_m": scale_m, "scale_error_percent": round(100 * (scale_m / true_m - 1), 4)}


def _pose_errors(
    cam_from_sfm: Poses, cam_from_world: Poses, world_from_sfm: Similarity
) -> dict[str, dict[str, float]]:
    centres_m = world_from_sfm.apply(_centres(cam_from_sfm, cam_from_sfm))
    centre_errors_m = np.linalg.norm(centres_m - _centres(cam_from_world, cam_from_sfm), axis=1)
    rotation_errors_deg = [
        rotation_angle_deg(cam_from_world[name][:3, :3] @ world_from_sfm.rotation @ pose[:3, :3].T)
        for name, pose in cam_from_sfm.items()
    ]
    return {
        "centre_error_mm": _median_and_largest(1000 * centre_errors_m),
        "rotation_error_deg": _median_and_largest(np.array(rotation_errors_deg)),
    }


def _centres(poses: Poses, names: Poses) -> Float64[ndarray, "n 3"]:
    return np.array([camera_centre(poses[name]) for name in names])


def _median_and_largest(errors: Float64[ndarray, " n"]) -> dict[str, float]:
    return {"median": round(float(np.median(errors)), 4), "largest": round(float(errors.max()), 4)}
