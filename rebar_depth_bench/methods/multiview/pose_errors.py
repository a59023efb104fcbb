"""Similarities between point sets, and angles of rotations: what lays a reconstruction on metres.

How far a reconstruction's cameras and scale are from the truth: told beside the depth, used for none of it.
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
    """``x -> scale * rotation @ x + translation``."""

    scale: float
    rotation: Float64[ndarray, "3 3"]
    translation: Float64[ndarray, " 3"]

    def points(self, source: Float64[ndarray, "*n 3"]) -> Float64[ndarray, "*n 3"]:
        """Apply it to points."""
        return np.asarray(self.scale * source @ self.rotation.T + self.translation)


def similarity(source: Float64[ndarray, "n 3"], target: Float64[ndarray, "n 3"]) -> Similarity:
    """Return the similarity with ``target ~ scale * rotation @ source + translation``, in least squares.

    For three or more points that are not on one line; those of a plane are fine: of the two rotations and mirrors
    that fit them equally the rotation is taken.
    Source: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991.
    """
    source_middle, target_middle = source.mean(axis=0), target.mean(axis=0)
    centred = source - source_middle
    u, singular, vt = np.linalg.svd((target - target_middle).T @ centred)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = u @ np.diag(signs) @ vt
    scale = float(singular @ signs / np.sum(centred**2))
    return Similarity(scale, rotation, target_middle - scale * rotation @ source_middle)


def rotation_deg(rotation: Float64[ndarray, "3 3"]) -> float:
    """Return the angle of a rotation, degrees."""
    skew = np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    return float(np.degrees(np.arctan2(np.linalg.norm(skew), np.trace(rotation) - 1)))


Poses = Mapping[str, Float64[ndarray, "4 4"]]


def true_similarity(cam_from_sfm: Poses, cam_from_world: Poses) -> Similarity:
    """Return the similarity that lays the cameras' centres on the true ones, metres; three or more."""
    return similarity(_centres(cam_from_sfm, cam_from_sfm), _centres(cam_from_world, cam_from_sfm))


def placed_report(cam_from_sfm: Poses, cam_from_world: Poses, metric: Similarity) -> dict[str, Any]:
    """Return errors of scale, centres and rotations under the similarity that was found to the board's frame."""
    return {
        **_scale_told(cam_from_sfm, cam_from_world, metric.scale),
        "cameras_compared": "in the board's frame",
        **_pose_errors(cam_from_sfm, cam_from_world, metric),
    }


def scaled_report(cam_from_sfm: Poses, cam_from_world: Poses, scale_m: float) -> dict[str, Any]:
    """Return errors of a scale found alone, and of the cameras under the best similarity to the true ones."""
    return {
        **_scale_told(cam_from_sfm, cam_from_world, scale_m),
        "cameras_compared": "after the best similarity",
        **_pose_errors(cam_from_sfm, cam_from_world, true_similarity(cam_from_sfm, cam_from_world)),
    }


def _scale_told(cam_from_sfm: Poses, cam_from_world: Poses, scale_m: float) -> dict[str, float]:
    true_m = true_similarity(cam_from_sfm, cam_from_world).scale
    return {"scale_m": scale_m, "scale_error_percent": round(100 * (scale_m / true_m - 1), 4)}


def _pose_errors(cam_from_sfm: Poses, cam_from_world: Poses, placed: Similarity) -> dict[str, dict[str, float]]:
    found_m = placed.points(_centres(cam_from_sfm, cam_from_sfm))
    off_m = np.linalg.norm(found_m - _centres(cam_from_world, cam_from_sfm), axis=1)
    turned_deg = [
        rotation_deg(cam_from_world[name][:3, :3] @ placed.rotation @ pose[:3, :3].T)
        for name, pose in cam_from_sfm.items()
    ]
    return {"centre_error_mm": _spread(1000 * off_m), "rotation_error_deg": _spread(np.array(turned_deg))}


def _centres(poses: Poses, names: Poses) -> Float64[ndarray, "n 3"]:
    return np.array([camera_centre(poses[name]) for name in names])


def _spread(errors: Float64[ndarray, " n"]) -> dict[str, float]:
    return {"median": round(float(np.median(errors)), 4), "largest": round(float(errors.max()), 4)}
