"""Initial poses and geometric checks of a simulated pile. World frame, metres, board at z = 0."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.assemblies.pile import Pose, points_in_world_m
from dataset_builder.scene.shapes.bending import resample_polyline_m
from rebar_depth_bench.geometry.aruco_board import MARKER_MODULES, BoardSpec, marker_corners_m

_COVERAGE_STEP_M = 0.002
"""Spacing at which centrelines are sampled to find the markers they cover, metres."""


@dataclass(frozen=True)
class DropSpec:
    """Distribution of the initial poses: stirrups above each other, their hoop centres near the z axis.

    The lowest starts at the height ``first_m``, each further one ``spacing_m`` above the one before. Each has a
    random face down, a yaw of up to ``yaw_deg`` in either direction, plus 180 degrees at random, a tilt of up to
    ``tilt_deg`` in any direction, and an offset of up to ``offset_m`` along x and y. At the default spacing
    stirrups do not touch at the start, whatever their tilt.
    """

    spacing_m: float = 0.085
    first_m: float = 0.050
    yaw_deg: float = 35.0
    tilt_deg: float = 10.0
    offset_m: float = 0.010


def drop_poses(
    drop: DropSpec, line_m: Float64[ndarray, "n 3"], stirrups: int, random: np.random.Generator
) -> list[Pose]:
    """Return random initial poses of ``stirrups`` stirrups of centreline ``line_m``, the lowest first."""
    hoop_middle_m = _hoop_middle_m(line_m)
    poses = []
    for level in range(stirrups):
        quaternion = _random_rotation(drop, random)
        hoop_target_m = np.array(
            [*random.uniform(-drop.offset_m, drop.offset_m, 2), drop.first_m + drop.spacing_m * level]
        )
        rotated_middle_m = points_in_world_m(hoop_middle_m[None], Pose((0.0, 0.0, 0.0), quaternion))[0]
        x, y, z = (float(value) for value in hoop_target_m - rotated_middle_m)
        poses.append(Pose((x, y, z), quaternion))
    return poses


def centre_pile(poses: Sequence[Pose], line_m: Float64[ndarray, "n 3"]) -> tuple[Pose, ...]:
    """Return the poses shifted so that the bounding box of the pile is centred on x = y = 0."""
    points_m = np.concatenate([points_in_world_m(line_m, pose) for pose in poses])
    middle_x, middle_y, _ = ((points_m.min(axis=0) + points_m.max(axis=0)) / 2).tolist()
    return tuple(
        Pose(
            (pose.position_m[0] - middle_x, pose.position_m[1] - middle_y, pose.position_m[2]),
            pose.quaternion_wxyz,
        )
        for pose in poses
    )


def reach_m(lines_m: Sequence[Float64[ndarray, "n 3"]], radius_m: float) -> float:
    """Return the largest absolute x or y coordinate of the steel, metres."""
    return float(max(np.abs(line[:, :2]).max() for line in lines_m) + radius_m)


def height_m(lines_m: Sequence[Float64[ndarray, "n 3"]], radius_m: float) -> float:
    """Return the largest z coordinate of the steel, metres."""
    return float(max(line[:, 2].max() for line in lines_m) + radius_m)


def tilts_deg(poses: Sequence[Pose]) -> list[float]:
    """Return the angle between each hoop's plane and the horizontal, degrees."""
    z_axis = np.array([[0.0, 0.0, 1.0]])
    normals = [points_in_world_m(z_axis, Pose((0.0, 0.0, 0.0), pose.quaternion_wxyz))[0] for pose in poses]
    return [float(np.rad2deg(np.arccos(min(1.0, abs(normal[2]))))) for normal in normals]


def free_markers(lines_m: Sequence[Float64[ndarray, "n 3"]], radius_m: float, board: BoardSpec) -> tuple[int, ...]:
    """Return the ids of the markers that are clear of steel in plan, with a quiet zone of one module."""
    points_m = np.concatenate([resample_polyline_m(line, _COVERAGE_STEP_M)[:, :2] for line in lines_m])
    quiet_m = board.marker_side_m / MARKER_MODULES
    free = []
    for marker_id, corners_m in marker_corners_m(board).items():
        low_m, high_m = corners_m[:, :2].min(axis=0) - quiet_m, corners_m[:, :2].max(axis=0) + quiet_m
        outside_m = np.maximum(np.maximum(low_m - points_m, points_m - high_m), 0.0)
        if np.linalg.norm(outside_m, axis=1).min() > radius_m:
            free.append(marker_id)
    return tuple(free)


def _random_rotation(drop: DropSpec, random: np.random.Generator) -> tuple[float, float, float, float]:
    """Return a random rotation as a quaternion (w, x, y, z): the face that is down, then yaw, then tilt."""
    face = _axis_angle_quaternion((1.0, 0.0, 0.0), 180.0 * random.integers(2))
    yaw = _axis_angle_quaternion(
        (0.0, 0.0, 1.0), random.uniform(-drop.yaw_deg, drop.yaw_deg) + 180.0 * random.integers(2)
    )
    tilt_axis_rad = random.uniform(0.0, 2 * np.pi)
    tilt = _axis_angle_quaternion(
        (np.cos(tilt_axis_rad), np.sin(tilt_axis_rad), 0.0), random.uniform(0.0, drop.tilt_deg)
    )
    w, x, y, z = (float(value) for value in _quaternion_product(tilt, _quaternion_product(yaw, face)))
    return (w, x, y, z)


def _axis_angle_quaternion(axis: tuple[float, float, float], angle_deg: float) -> Float64[ndarray, " 4"]:
    """Return the quaternion (w, x, y, z) of a rotation about a unit ``axis``."""
    half = np.deg2rad(angle_deg) / 2
    return np.array([np.cos(half), *(np.sin(half) * np.array(axis))])


def _quaternion_product(last: Float64[ndarray, " 4"], first: Float64[ndarray, " 4"]) -> Float64[ndarray, " 4"]:
    """Return the quaternion (w, x, y, z) of the rotation ``first`` followed by ``last``."""
    scalar = last[0] * first[0] - last[1:] @ first[1:]
    vector = last[0] * first[1:] + first[0] * last[1:] + np.cross(last[1:], first[1:])
    return np.array([scalar, *vector])


def _hoop_middle_m(line_m: Float64[ndarray, "n 3"]) -> Float64[ndarray, " 3"]:
    """Return the bounding-box centre of the hoop, which differs from the centroid because of the hooks."""
    middle: Float64[ndarray, " 3"] = (line_m.min(axis=0) + line_m.max(axis=0)) / 2
    return middle
