"""Depth against the lens model of OpenCV: each pixel's point, projected by ``cv2``, comes back to its pixel."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from dataset_builder.audit.report import Check
from dataset_builder.audit.views import AuditedConfig, AuditedEye, AuditedView

MAX_PROJECTION_ERROR_PX = 1e-6
_PIXELS = 60_000
"""Of an eye, evenly spread: OpenCV also makes 15 derivatives a coordinate, seconds and 200 MB for all pixels."""


def view_projection_error_px(_: AuditedConfig, view: AuditedView) -> float:
    """Return the largest ``projection_error_px`` of both eyes."""
    return max(projection_error_px(eye) for eye in view.eyes.values())


def projection_error_px(eye: AuditedEye) -> float:
    """Return how far from its pixel a point lands at most, pixels; 0 for an eye that sees nothing.

    At most 60,000 pixels, evenly spread, are looked at. The point comes from the stored depth, our rays and the
    stored pose. Rodrigues vector and projection are OpenCV's (``cv2.projectPoints``, the model of its calib3d
    documentation), not ours.
    """
    seen = np.flatnonzero(eye.depth_m)
    if not len(seen):
        return 0.0
    if len(seen) > _PIXELS:
        seen = seen[np.linspace(0, len(seen) - 1, _PIXELS).astype(int)]
    pose = eye.camera.cam_from_world
    rotation_rad = cv2.Rodrigues(pose[:3, :3])[0]
    points_m = eye.points_m.reshape(-1, 3)[seen]
    found, _ = cv2.projectPoints(points_m, rotation_rad, pose[:3, 3], eye.camera.K, eye.camera.distortion)
    v, u = np.divmod(seen, eye.camera.width)
    return float(np.abs(found[:, 0] - np.stack([u, v], axis=1)).max())


def projection_verdict(config: AuditedConfig, errors_px: Sequence[float]) -> Check:
    """Hold the largest error of the views looked at against its bound."""
    worst_px = max(errors_px, default=0.0)
    problem = f"a pixel's point lands {worst_px:.2e} px from it in cv2.projectPoints"
    return Check(
        f"{config.name}: points through OpenCV's lens model",
        f"{len(errors_px)} views: at most {worst_px:.1e} px",
        f"{MAX_PROJECTION_ERROR_PX:g} px",
        () if worst_px <= MAX_PROJECTION_ERROR_PX else (problem,),
    )
