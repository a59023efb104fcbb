"""Walls and strips before a left camera that stands in the world's origin, and scanners to look at them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dataset_builder.lidar import SURVEY, ScannerSpec
from dataset_builder.lidar.beams import sector_of
from dataset_builder.lidar.project import LeftCamera, left_depth_m
from dataset_builder.lidar.simulate import noise_generator, scan
from dataset_builder.scene.model import WorldMesh
from dataset_builder.scene.raycast import RayCaster
from rebar_depth_bench.geometry.cameras import ideal_K, pixel_rays

WIDTH, HEIGHT = 64, 36
FAR_M = 100.0

PERFECT = replace(
    SURVEY,
    azimuth_step_rad=0.01,
    elevation_step_rad=0.01,
    elevation_limits_rad=(-1.5, 1.5),
    divergence_rad=0.0,
    exit_diameter_m=0.0,
    rays_per_beam=1,
    min_range_m=0.0,
    noise_m=0.0,
)
"""Infinitely thin beams without noise."""


def quad(corners: list[tuple[float, float, float]]) -> WorldMesh:
    """A flat four-cornered face."""
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return WorldMesh(np.array(corners, dtype=float), faces, np.zeros(2, np.uint16))


def wall(depth_m: float, left_m: float = -FAR_M, right_m: float = FAR_M, slope: float = 0.0) -> WorldMesh:
    """A wall across the view, as high as can be: planar depth ``depth_m + slope * x``."""
    near, far = depth_m + slope * left_m, depth_m + slope * right_m
    return quad(
        [(left_m, -FAR_M, near), (right_m, -FAR_M, far), (right_m, FAR_M, far), (left_m, FAR_M, near)],
    )


def joined(*meshes: WorldMesh) -> WorldMesh:
    """Several meshes as one."""
    starts = np.cumsum([0, *(len(mesh.vertices_m) for mesh in meshes)])
    return WorldMesh(
        np.concatenate([mesh.vertices_m for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]).astype(np.int32),
        np.concatenate([mesh.face_bar_id for mesh in meshes]),
    )


def camera(distortion: np.ndarray | None = None) -> LeftCamera:
    """A small left camera."""
    lens = np.zeros(5) if distortion is None else distortion
    K = ideal_K(WIDTH, HEIGHT)
    return LeftCamera(K, lens, pixel_rays(K, WIDTH, HEIGHT, lens))


def seen(spec: ScannerSpec, mesh: WorldMesh, view: LeftCamera | None = None) -> np.ndarray:
    """What the scanner answers on the left grid."""
    view = view or camera()
    sector = sector_of(spec, view.rays)
    range_m = scan(RayCaster(mesh), spec, sector, spec.lidar_from_left, noise_generator("test/0000"))
    return left_depth_m(spec, sector, range_m, view)
