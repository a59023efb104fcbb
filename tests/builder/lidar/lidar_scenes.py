"""Walls and strips in front of a left camera at the world origin, and scans of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dataset_builder.lidar.scan_method import scan_depth_m
from dataset_builder.lidar.scanner import SURVEY, ScannerSpec
from dataset_builder.scene.model import Mesh, WorldMesh
from dataset_builder.scene.raycast import RayCaster
from dataset_builder.scene.shapes.solids import world_mesh
from rebar_depth_bench.geometry.cameras import Camera, ideal_K

WIDTH, HEIGHT = 64, 36
FAR_M = 100.0

PERFECT = replace(
    SURVEY,
    azimuth_step_rad=0.01,
    elevation_step_rad=0.01,
    elevation_limits_rad=(-1.5, 1.5),
    divergence_sigma_rad=0.0,
    exit_sigma_m=0.0,
    rays_per_beam=1,
    min_range_m=0.1,
    noise_m=0.0,
)
"""Scanner with infinitely thin beams and without noise."""


def wall(depth_m: float, left_m: float = -FAR_M, right_m: float = FAR_M, slope: float = 0.0) -> WorldMesh:
    """Return a wall of planar depth ``depth_m + slope * x`` that covers the whole height of the view."""
    near, far = depth_m + slope * left_m, depth_m + slope * right_m
    corners_m = [(left_m, -FAR_M, near), (right_m, -FAR_M, far), (right_m, FAR_M, far), (left_m, FAR_M, near)]
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return WorldMesh(np.array(corners_m), faces, np.zeros(2, np.uint16))


def concatenate_meshes(*meshes: WorldMesh) -> WorldMesh:
    """Return the union of several meshes."""
    return world_mesh([Mesh(mesh.vertices_m, mesh.faces) for mesh in meshes], [0] * len(meshes))


def camera(distortion: np.ndarray | None = None) -> Camera:
    """Return a small left camera at the world origin."""
    lens = np.zeros(5) if distortion is None else distortion
    return Camera(ideal_K(WIDTH, HEIGHT), lens, np.eye(4), WIDTH, HEIGHT)


def scanned_depth_m(spec: ScannerSpec, mesh: WorldMesh, view: Camera | None = None) -> np.ndarray:
    """Return the planar depth of a scan on the pixel grid of the left camera, in metres."""
    return scan_depth_m(RayCaster(mesh), spec, view or camera(), "test/0000")
