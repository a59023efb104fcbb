"""How far a reconstruction's cameras and scale are from the truth: told beside the depth, used for none of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.cameras import camera_centre
from rebar_depth_bench.methods.multiview.similarity import Similarity, rotation_deg, similarity

Poses = Mapping[str, Float64[ndarray, "4 4"]]


def true_similarity(cam_from_sfm: Poses, cam_from_world: Poses) -> Similarity:
    """Return the similarity that lays the cameras' centres on the true ones, metres; three or more."""
    return similarity(_centres(cam_from_sfm, cam_from_sfm), _centres(cam_from_world, cam_from_sfm))


def pose_report(cam_from_sfm: Poses, cam_from_world: Poses, metric: Similarity | float) -> dict[str, Any]:
    """Return scale, centre and rotation errors of the cameras, as plain numbers.

    ``metric`` is the similarity that was found from the reconstruction to the world, or its scale alone where no
    frame was: then cameras are laid on the true ones by the best similarity before they are compared.
    """
    truth = true_similarity(cam_from_sfm, cam_from_world)
    scale = metric if isinstance(metric, float) else metric.scale
    placed = truth if isinstance(metric, float) else metric
    off_m = np.linalg.norm(
        placed.points(_centres(cam_from_sfm, cam_from_sfm)) - _centres(cam_from_world, cam_from_sfm), axis=1
    )
    turned_deg = [
        rotation_deg(cam_from_world[name][:3, :3] @ placed.rotation @ pose[:3, :3].T)
        for name, pose in cam_from_sfm.items()
    ]
    return {
        "scale_m": scale,
        "scale_error_percent": round(100 * (scale / truth.scale - 1), 4),
        "cameras_compared": "after the best similarity" if isinstance(metric, float) else "in the board's frame",
        "centre_error_mm": _spread(1000 * off_m),
        "rotation_error_deg": _spread(np.array(turned_deg)),
    }


def _centres(poses: Poses, names: Poses) -> Float64[ndarray, "n 3"]:
    return np.array([camera_centre(poses[name]) for name in names])


def _spread(errors: Float64[ndarray, " n"]) -> dict[str, float]:
    return {"median": round(float(np.median(errors)), 4), "largest": round(float(errors.max()), 4)}
