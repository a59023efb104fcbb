"""A small scene for tests of the audit: the printed board and three bars, seen without Blender on any grid.

Depth comes from the ray caster, colour from looking the board's print up at the same points, over 2 x 2 rays a
pixel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float64, UInt8
from numpy import ndarray

from dataset_builder.audit.views import AuditedConfig, AuditedEye, AuditedView
from dataset_builder.config.rigs import Camera, rig_cameras
from dataset_builder.config.specs import RigSpec
from dataset_builder.config.trajectories import aim_rig
from dataset_builder.scene.board_texture import board_texture
from dataset_builder.scene.model import Bar, WorldMesh
from dataset_builder.scene.raycast import EyeTruth, RayCaster
from dataset_builder.scene.shapes.bar_mesh import plain_bar_mesh
from dataset_builder.scene.shapes.bending import bent_line_m
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.geometry.cameras import inverse_rigid, pixel_rays, transform
from rebar_depth_bench.geometry.stereo_calibration import Lens, StereoCalibration

BOARD = BoardSpec()
PX_PER_M = 6000.0
RAYS_ACROSS = 2
STEEL_LEVEL = 60
FLOOR_LEVEL = 120
WIDTH, HEIGHT = 640, 360
TARGET_M = np.array([0.0, 0.0, 0.02])

RAW = StereoCalibration(
    1280,
    720,
    Lens(701.88, 701.70, 641.285, 344.1835, (-0.175286, 0.0283094, 6.68e-5, -1.50e-4, 0.0)),
    Lens(700.965, 701.11, 633.515, 359.3135, (-0.172795, 0.0265223, 1.64e-4, 1.02e-5, 0.0)),
    (-9.17e-4, 6.24e-3, 7.70e-4),
    (-0.12, 0.0, 0.0),
)
"""A real unit's lenses and rotation; the baseline made round."""

RIGS = {
    "ideal": RigSpec(WIDTH, HEIGHT),
    "raw": RigSpec(WIDTH, HEIGHT, 0.12, RAW, "raw"),
    "rectified": RigSpec(WIDTH, HEIGHT, 0.12, RAW, "rectified"),
}


@dataclass(frozen=True, eq=False)
class Scene:
    """Bars and the caster that knows them and the floor."""

    steel: tuple[Bar, ...]
    caster: RayCaster


@cache
def scene() -> Scene:
    """Two straight bars across each other, and a bent one, on the floor z = 0."""
    bent = bent_line_m(np.array([[-0.08, -0.09, 0.012], [0.08, -0.09, 0.012], [0.08, -0.02, 0.012]]), 0.025)
    lines = [
        np.array([[-0.12, 0.0, 0.02], [0.12, 0.0, 0.02]]),
        np.array([[0.0, -0.05, 0.04], [0.0, 0.12, 0.04]]),
        bent,
    ]
    steel = tuple(
        Bar(n, "bar", 0.010, tuple((float(x), float(y), float(z)) for x, y, z in line))
        for n, line in enumerate(lines, start=1)
    )
    meshes = [plain_bar_mesh(line, 0.010) for line in lines]
    floor_m = np.array([[-9.0, -9.0, 0.0], [9.0, -9.0, 0.0], [9.0, 9.0, 0.0], [-9.0, 9.0, 0.0]])
    vertices = [*(mesh.vertices_m for mesh in meshes), floor_m]
    faces = [*(mesh.faces for mesh in meshes), np.array([[0, 1, 2], [0, 2, 3]])]
    starts = np.cumsum([0, *(len(part) for part in vertices)])
    ids = np.repeat([1, 2, 3, 0], [len(part) for part in faces]).astype(np.uint16)
    joined = np.concatenate([part + start for part, start in zip(faces, starts, strict=False)]).astype(np.int32)
    return Scene(steel, RayCaster(WorldMesh(np.concatenate(vertices), joined, ids)))


def config(board: BoardSpec | None = BOARD, kind: str = "pile", variants: tuple[str, ...] = ()) -> AuditedConfig:
    """The scene's config, with as much of a manifest entry as checks read."""
    entry: dict[str, Any] = {"scene": {"assembly": {"kind": kind}, "appearance": {"variants": list(variants)}}}
    return AuditedConfig("scene", entry, scene().steel, board)


@cache
def view(rig: str, azimuth_deg: float = 20.0, distance_m: float = 0.35) -> AuditedView:
    """A view from 50 degrees above the board."""
    azimuth, elevation = np.deg2rad(azimuth_deg), np.deg2rad(50.0)
    level = np.cos(elevation)
    towards = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
    pose = aim_rig(TARGET_M + distance_m * towards, TARGET_M, 0.12)
    eyes = {name: seen_by(camera) for name, camera in rig_cameras(RIGS[rig], pose).items()}
    return AuditedView("scene/0000", eyes["left"], eyes["right"])


def seen_by(camera: Camera) -> AuditedEye:
    """What a camera sees of the scene: exact depth, and colour of 2 x 2 rays a pixel."""
    rays_cam = pixel_rays(camera.K, camera.width, camera.height, camera.distortion)
    truth = scene().caster.cast(rays_cam, camera.cam_from_world)
    return AuditedEye(camera, _colour(camera), truth.depth_m, truth.mask, truth.bars, rays_cam)


def _colour(camera: Camera) -> UInt8[ndarray, "h w 3"]:
    finer = camera.K.copy()
    finer[:2] *= RAYS_ACROSS
    finer[:2, 2] += (RAYS_ACROSS - 1) / 2
    width, height = RAYS_ACROSS * camera.width, RAYS_ACROSS * camera.height
    rays_cam = pixel_rays(finer, width, height, camera.distortion)
    truth = scene().caster.cast(rays_cam, camera.cam_from_world)
    levels = np.where(truth.mask, STEEL_LEVEL, _print_levels(rays_cam, truth, camera))
    mean = levels.reshape(camera.height, RAYS_ACROSS, camera.width, RAYS_ACROSS).mean(axis=(1, 3))
    return np.repeat(np.round(mean).astype(np.uint8)[..., None], 3, axis=2)


def _print_levels(rays_cam: Float64[ndarray, "h w 3"], truth: EyeTruth, camera: Camera) -> ndarray:
    points_m = transform(inverse_rigid(camera.cam_from_world), rays_cam * truth.depth_m[..., None])
    column = (points_m[..., 0] + BOARD.width_m / 2) * PX_PER_M - 0.5
    row = (BOARD.height_m / 2 - points_m[..., 1]) * PX_PER_M - 0.5
    at = (column.astype(np.float32), row.astype(np.float32))
    border = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": FLOOR_LEVEL}
    return np.asarray(cv2.remap(_printed(), *at, cv2.INTER_LINEAR, **border))


@cache
def _printed() -> UInt8[ndarray, "h w"]:
    return board_texture(BOARD, PX_PER_M)


def with_camera(eye: AuditedEye, **changes: Any) -> AuditedEye:
    """The eye with a camera that says something else, and the rays that follow from it."""
    camera = replace(eye.camera, **changes)
    rays_cam = pixel_rays(camera.K, camera.width, camera.height, camera.distortion)
    return replace(eye, camera=camera, rays_cam=rays_cam)


def with_depth(seen: AuditedView, factor: float) -> AuditedView:
    """The view with the depth of both eyes times a factor."""
    left, right = (replace(eye, depth_m=(eye.depth_m * np.float32(factor))) for eye in (seen.left, seen.right))
    return AuditedView(seen.view_id, left, right)


def with_baseline(seen: AuditedView, more_m: float) -> AuditedView:
    """The view with a right camera that says it stands further off."""
    pose = seen.right.camera.cam_from_world.copy()
    pose[0, 3] -= more_m
    return AuditedView(seen.view_id, seen.left, with_camera(seen.right, cam_from_world=pose))


def with_K_shift(seen: AuditedView, eyes: tuple[str, ...], axis: int, px: float) -> AuditedView:
    """The view with the principal points of some eyes elsewhere along u (0) or v (1)."""
    changed = dict(seen.eyes)
    for name in eyes:
        K = changed[name].camera.K.copy()
        K[axis, 2] += px
        changed[name] = with_camera(changed[name], K=K)
    return AuditedView(seen.view_id, changed["left"], changed["right"])
