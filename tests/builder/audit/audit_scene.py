"""Small synthetic scene for tests of the audit: the printed board and three bars, imaged without Blender.

Depth is ray-cast; colour is sampled from the board texture at the same points with 2 x 2 rays per pixel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float64, UInt8
from numpy import ndarray

from dataset_builder.audit.checks import AuditedConfig, AuditedEye, AuditedView
from dataset_builder.cameras.rigs import rig_cameras
from dataset_builder.cameras.trajectories import look_at_with_rig
from dataset_builder.scene.board_texture import board_texture
from dataset_builder.scene.model import Mesh, axis_of
from dataset_builder.scene.raycast import RayCaster
from dataset_builder.scene.shapes.bar_mesh import plain_bar_mesh
from dataset_builder.scene.shapes.bending import bent_line_m
from dataset_builder.scene.shapes.solids import world_mesh
from dataset_builder.specs.config_specs import RigSpec
from rebar_depth_bench.captures.calibration import Lens, StereoCalibration
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.data.rows import RenderedEye
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.geometry.cameras import Camera, inverse_rigid, transform

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
"""Calibration of a real ZED with the baseline rounded to 0.12 m."""

RIGS = {
    "ideal": RigSpec(WIDTH, HEIGHT),
    "raw": RigSpec(WIDTH, HEIGHT, 0.12, RAW, "raw"),
    "rectified": RigSpec(WIDTH, HEIGHT, 0.12, RAW, "rectified"),
}


@dataclass(frozen=True, eq=False)
class Scene:
    """Bars and a ray caster of the bars and the floor."""

    steel: tuple[Bar, ...]
    caster: RayCaster


@cache
def scene() -> Scene:
    """Return a scene of two crossing straight bars and a bent one above the floor z = 0."""
    bent_axis_m = bent_line_m(np.array([[-0.08, -0.09, 0.012], [0.08, -0.09, 0.012], [0.08, -0.02, 0.012]]), 0.025)
    axes_m = [
        np.array([[-0.12, 0.0, 0.02], [0.12, 0.0, 0.02]]),
        np.array([[0.0, -0.05, 0.04], [0.0, 0.12, 0.04]]),
        bent_axis_m,
    ]
    steel = tuple(Bar(n, "bar", 0.010, axis_of(axis_m)) for n, axis_m in enumerate(axes_m, start=1))
    meshes = [plain_bar_mesh(axis_m, 0.010) for axis_m in axes_m]
    floor_m = np.array([[-9.0, -9.0, 0.0], [9.0, -9.0, 0.0], [9.0, 9.0, 0.0], [-9.0, 9.0, 0.0]])
    floor = Mesh(floor_m, np.array([[0, 1, 2], [0, 2, 3]], np.int32))
    return Scene(steel, RayCaster(world_mesh([*meshes, floor], [1, 2, 3, 0])))


def config(board: BoardSpec | None = BOARD, variants: tuple[str, ...] = ()) -> AuditedConfig:
    """Return the config of the scene."""
    return AuditedConfig(variants, scene().steel, board)


@cache
def view(rig: str, azimuth_deg: float = 20.0, distance_m: float = 0.35) -> AuditedView:
    """Return a view from an elevation of 50 degrees."""
    azimuth, elevation = np.deg2rad(azimuth_deg), np.deg2rad(50.0)
    level = np.cos(elevation)
    towards = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
    pose = look_at_with_rig(TARGET_M + distance_m * towards, TARGET_M, 0.12)
    eyes = {name: render_eye(camera) for name, camera in rig_cameras(RIGS[rig], pose).items()}
    return AuditedView("scene/0000", eyes["left"], eyes["right"])


def render_eye(camera: Camera) -> AuditedEye:
    """Return the view of a camera: exact depth, and colour averaged over 2 x 2 rays per pixel."""
    rays_cam = camera.rays()
    truth = scene().caster.cast(camera, rays_cam)
    return AuditedEye(camera, _colour(camera), truth.depth_m, truth.mask, truth.bars, rays_cam)


def _colour(camera: Camera) -> UInt8[ndarray, "h w 3"]:
    fine_K = camera.K.copy()
    fine_K[:2] *= RAYS_ACROSS
    fine_K[:2, 2] += (RAYS_ACROSS - 1) / 2
    fine = replace(camera, K=fine_K, width=RAYS_ACROSS * camera.width, height=RAYS_ACROSS * camera.height)
    rays_cam = fine.rays()
    truth = scene().caster.cast(fine, rays_cam)
    levels = np.where(truth.mask, STEEL_LEVEL, _board_levels(rays_cam, truth))
    mean = levels.reshape(camera.height, RAYS_ACROSS, camera.width, RAYS_ACROSS).mean(axis=(1, 3))
    return np.repeat(np.round(mean).astype(np.uint8)[..., None], 3, axis=2)


def _board_levels(rays_cam: Float64[ndarray, "h w 3"], truth: RenderedEye) -> ndarray:
    points_m = transform(inverse_rigid(truth.camera.cam_from_world), rays_cam * truth.depth_m[..., None])
    column = (points_m[..., 0] + BOARD.width_m / 2) * PX_PER_M - 0.5
    row = (BOARD.height_m / 2 - points_m[..., 1]) * PX_PER_M - 0.5
    at = (column.astype(np.float32), row.astype(np.float32))
    border = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": FLOOR_LEVEL}
    return np.asarray(cv2.remap(_board_texture(), *at, cv2.INTER_LINEAR, **border))


@cache
def _board_texture() -> UInt8[ndarray, "h w"]:
    return board_texture(BOARD, PX_PER_M)


def with_camera(eye: AuditedEye, **changes: Any) -> AuditedEye:
    """Return ``eye`` with changed camera parameters and the corresponding rays."""
    camera = replace(eye.camera, **changes)
    return replace(eye, camera=camera, rays_cam=camera.rays())


def with_depth(original: AuditedView, factor: float) -> AuditedView:
    """Return the view with the depth of both cameras multiplied by ``factor``."""
    left, right = (
        replace(eye, depth_m=(eye.depth_m * np.float32(factor))) for eye in (original.left, original.right)
    )
    return AuditedView(original.view_id, left, right)


def with_baseline(original: AuditedView, more_m: float) -> AuditedView:
    """Return the view with the right camera displaced by ``more_m`` along the baseline."""
    pose = original.right.camera.cam_from_world.copy()
    pose[0, 3] -= more_m
    return AuditedView(original.view_id, original.left, with_camera(original.right, cam_from_world=pose))


def with_K_shift(original: AuditedView, eyes: tuple[str, ...], axis: int, px: float) -> AuditedView:
    """Return the view with the principal points of ``eyes`` shifted by ``px`` along u (axis 0) or v (axis 1)."""
    changed = dict(original.eyes)
    for name in eyes:
        K = changed[name].camera.K.copy()
        K[axis, 2] += px
        changed[name] = with_camera(changed[name], K=K)
    return AuditedView(original.view_id, changed["left"], changed["right"])
