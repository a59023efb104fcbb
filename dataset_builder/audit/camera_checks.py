"""Camera checks of the audit: poses and intrinsics against the manifest, pixel rays against OpenCV.

The expected cameras are rebuilt from the specs of trajectory and rig in the manifest: the trajectory's poses are
passed through the rig.
The lens model is checked by projecting the 3-D point of each pixel with ``cv2.projectPoints``: it must return to
its pixel.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.audit.checks import AuditedConfig, AuditedEye, AuditedView, Check
from dataset_builder.cameras.rigs import rig_cameras
from dataset_builder.cameras.trajectories import aim_point_m, poses, subset
from dataset_builder.scene.mesh_ply import read_mesh_ply
from dataset_builder.scene.model import NOT_STEEL, Assembly, Mesh, Part
from dataset_builder.specs.manifest_specs import rig_spec, trajectory_spec
from rebar_depth_bench.base.errors import DatasetError
from rebar_depth_bench.base.names import scene_prefix, view_id
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.data.schema import CAMERA_SHAPES, EYES
from rebar_depth_bench.geometry.cameras import Camera, camera_centre

CAMERA_TOLERANCE = 1e-12
"""Largest absolute difference of any entry of K, distortion or pose.

The results of sine and cosine differ by this much between machines.
"""
_AIM_TOLERANCE_M = 0.0011
"""Largest difference of the aim point per axis, metres.

The aim point is rounded to the millimetre, and the float32 vertices of the mesh may round to the neighbouring one.
"""
MAX_PROJECTION_ERROR_PX = 1e-6
"""Largest distance of a reprojected point from its pixel centre, pixels."""
_MAX_PROJECTED_PIXELS = 60_000
"""Pixels projected per eye, evenly spaced.

OpenCV also computes 15 derivatives per coordinate, which takes seconds and 200 MB for all pixels.
"""


@dataclass(frozen=True, eq=False)
class ExpectedView:
    """Expected id, cameras by eye and baseline of a view."""

    view_id: str
    cameras: Mapping[str, Camera]
    baseline_m: float


def mesh_aim_point_m(mesh: Path) -> Float64[ndarray, " 3"]:
    """Return the point that the cameras aim at, world metres: the middle of the mesh's steel, rounded to 1 mm.

    Raises ``DatasetError`` if the file is not a mesh of this dataset or holds no steel.
    """
    scene = read_mesh_ply(mesh)
    steel = scene.vertices_m[np.unique(scene.faces[scene.face_bar_id != NOT_STEEL])]
    if not len(steel):
        raise DatasetError(f"{mesh}: contains no steel, expected the bars of its scene")
    return aim_point_m(Assembly((), (Part("steel", Mesh(steel, scene.faces[:0]), 1, "steel"),)))


def checked_aim_point_m(config: DatasetConfig, mesh: Path) -> tuple[Float64[ndarray, " 3"], tuple[str, ...]]:
    """Return a config's aim point, world metres, and the problems found with it.

    This is ``aim_point_m`` of its scene if it agrees with the middle of the mesh's steel. If the manifest
    has no aim point, or a different one (a problem), the middle of the steel is returned.
    """
    middle_m = mesh_aim_point_m(mesh)
    aim_m = config.scene.aim_point_m
    if aim_m is None:
        return middle_m, ()
    if not np.abs(np.array(aim_m) - middle_m).max() <= _AIM_TOLERANCE_M:
        return middle_m, (f"aim_point_m is {list(aim_m)}, expected {middle_m.tolist()}, the centre of the steel",)
    return np.array(aim_m), ()


def expected_views(
    config: DatasetConfig, aim_m: Float64[ndarray, " 3"], bars: Sequence[Bar] = ()
) -> list[ExpectedView]:
    """Return the expected views of a config in order.

    They follow from its manifest entry, the aim point (world metres), and the bars of its scene if the trajectory
    is measured from the nearest steel.

    Raises ``DatasetError`` if the manifest's trajectory or rig is not one that this version writes.
    """
    rig = rig_spec(config)
    trajectory = trajectory_spec(config)
    try:
        left_poses = poses(trajectory, aim_m, rig, bars)
        prefix = scene_prefix(config.scene.split, config.scene.name) if config.has_splits else ""
        return [
            ExpectedView(view_id(config.name, index, prefix), rig_cameras(rig, left_poses[index]), rig.baseline_m)
            for index in subset(len(left_poses), len(config.views))
        ]
    except ValueError as error:
        raise DatasetError(f"manifest: the protocol or rig of config {config.name} is invalid: {error}") from None


def view_list_problems(config: DatasetConfig, views: Sequence[ExpectedView]) -> Iterator[str]:
    """Yield a problem unless the manifest has the ids of the expected views, in their order."""
    pairs = list(zip(config.view_ids, [view.view_id for view in views], strict=False))
    different = [
        f": the first difference is {found}, expected {wanted}" for found, wanted in pairs if found != wanted
    ]
    if different or len(config.views) != len(views):
        yield (
            f"the manifest lists {len(config.views)} views, expected the {len(views)} views of its trajectory"
            f"{''.join(different[:1])}"
        )


def camera_problems(row: Mapping[str, Any], expected: ExpectedView) -> Iterator[str]:
    """Yield the differences of a decoded row's cameras and baseline from the expected ones."""
    for eye, camera in expected.cameras.items():
        for kind in CAMERA_SHAPES:
            deviation = float(np.abs(row[f"{eye}_{kind}"] - getattr(camera, kind)).max())
            if not deviation <= CAMERA_TOLERANCE:
                yield f"{eye}_{kind} differs by {deviation:.1e} from the value given by the protocol and the rig"
    yield from _rig_problems(row, expected.baseline_m)


def _rig_problems(row: Mapping[str, Any], baseline_m: float) -> Iterator[str]:
    if abs(row["baseline_m"] - baseline_m) > CAMERA_TOLERANCE:
        yield f"baseline_m is {row['baseline_m']}, expected {baseline_m}"
    left_m, right_m = (camera_centre(row[f"{eye}_cam_from_world"]) for eye in EYES)
    centre_distance_m = float(np.linalg.norm(right_m - left_m))
    if not abs(centre_distance_m - row["baseline_m"]) <= 1e-9:
        yield f"the camera centres are {centre_distance_m:.9f} m apart, expected baseline_m = {row['baseline_m']}"
    for eye in EYES:
        rotation = row[f"{eye}_cam_from_world"][:3, :3]
        deviation = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
        if not deviation <= CAMERA_TOLERANCE or not np.linalg.det(rotation) > 0:
            yield f"{eye}_cam_from_world is not a rigid pose (deviation {deviation:.1e})"


def view_projection_error_px(_: AuditedConfig, view: AuditedView) -> float:
    """Return the larger ``projection_error_px`` of both eyes."""
    return max(projection_error_px(eye) for eye in view.eyes.values())


def projection_error_px(eye: AuditedEye) -> float:
    """Return the largest distance of a reprojected point from its pixel centre, pixels.

    The result is 0 for an eye without depth. At most 60,000 evenly spaced pixels are used. A point is computed
    from the stored depth, the pixel rays of this project and the stored pose. The Rodrigues vector and the
    projection are OpenCV's (``cv2.projectPoints``, the model of its calib3d documentation).
    """
    pixels = np.flatnonzero(eye.depth_m)
    if not len(pixels):
        return 0.0
    if len(pixels) > _MAX_PROJECTED_PIXELS:
        pixels = pixels[np.linspace(0, len(pixels) - 1, _MAX_PROJECTED_PIXELS).astype(int)]
    pose = eye.camera.cam_from_world
    rotation_rad = cv2.Rodrigues(pose[:3, :3])[0]
    points_m = eye.points_m.reshape(-1, 3)[pixels]
    projected_px, _ = cv2.projectPoints(points_m, rotation_rad, pose[:3, 3], eye.camera.K, eye.camera.distortion)
    v, u = np.divmod(pixels, eye.camera.width)
    return float(np.abs(projected_px[:, 0] - np.stack([u, v], axis=1)).max())


def projection_verdict(_: AuditedConfig, errors_px: Sequence[float]) -> Check:
    """Return the check of the largest reprojection error of the measured views."""
    worst_px = max(errors_px, default=0.0)
    problem = f"cv2.projectPoints projects a pixel's 3-D point {worst_px:.2e} px away from the pixel"
    return Check(
        "reprojection with OpenCV's lens model",
        f"{len(errors_px)} views: at most {worst_px:.1e} px",
        f"{MAX_PROJECTION_ERROR_PX:g} px",
        () if worst_px <= MAX_PROJECTION_ERROR_PX else (problem,),
    )
