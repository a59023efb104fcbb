"""Walls and strips in front of a left camera at the world origin, and scans of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dataset_builder.lidar import SURVEY, ScannerSpec
from dataset_builder.lidar.beams import visible_sector
from dataset_builder.lidar.project import LeftCamera, left_depth_m
from dataset_builder.lidar.simulate import noise_generator, simulate_scan
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
"""Scanner with infinitely thin beams and without noise."""


def quad(corners: list[tuple[float, float, float]]) -> WorldMesh:
    """Return a planar quadrilateral."""
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return WorldMesh(np.array(corners, dtype=float), faces, np.zeros(2, np.uint16))


def wall(depth_m: float, left_m: float = -FAR_M, right_m: float = FAR_M, slope: float = 0.0) -> WorldMesh:
    """Return a wall of planar depth ``depth_m + slope * x`` that covers the whole height of the view."""
    near, far = depth_m + slope * left_m, depth_m + slope * right_m
    return quad(
        [(left_m, -FAR_M, near), (right_m, -FAR_M, far), (right_m, FAR_M, far), (left_m, FAR_M, near)],
    )


def concatenate_meshes(*meshes: WorldMesh) -> WorldMesh:
    """Return the union of several meshes."""
    vertex_offsets = np.cumsum([0, *(len(mesh.vertices_m) for mesh in meshes)])
    return WorldMesh(
        np.concatenate([mesh.vertices_m for mesh in meshes]),
        np.concatenate([mesh.faces + offset for mesh, offset in zip(meshes, vertex_offsets, strict=False)]).astype(
            np.int32
        ),
        np.concatenate([mesh.face_bar_id for mesh in meshes]),
    )


def camera(distortion: np.ndarray | None = None) -> LeftCamera:
    """Return a small left camera."""
    lens = np.zeros(5) if distortion is None else distortion
    K = ideal_K(WIDTH, HEIGHT)
    return LeftCamera(K, lens, pixel_rays(K, WIDTH, HEIGHT, lens))


def scan_depth_m(spec: ScannerSpec, mesh: WorldMesh, view: LeftCamera | None = None) -> np.ndarray:
    """Return the planar depth of a scan on the pixel grid of the left camera, in metres."""
    view = view or camera()
    sector = visible_sector(spec, view.rays)
    range_m = simulate_scan(RayCaster(mesh), spec, sector, spec.lidar_from_left, noise_generator("test/0000"))
    return left_depth_m(spec, sector, range_m, view)
