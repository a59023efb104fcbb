"""How stirrups are thrown on a heap, and what the heap must be like. World frame, metres, board at z = 0."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.assemblies.pile import Pose, placed_m
from dataset_builder.scene.shapes.bending import resampled_m
from rebar_depth_bench.geometry.aruco_board import MARKER_MODULES, BoardSpec, marker_corners_m

_SAMPLE_M = 0.002
"""Centrelines are looked at this finely when it is asked what they cover."""


@dataclass(frozen=True)
class DropSpec:
    """How stirrups start: one over the other, ``spacing_m`` apart, the middles of their hoops near the z axis.

    Each lies on either face, turned by up to ``yaw_deg`` either way or half a turn more, tilted by up to
    ``tilt_deg`` in any direction and moved by up to ``offset_m`` along x and y. At this spacing none touches
    another at the start, whichever way they tilt.
    """

    spacing_m: float = 0.085
    first_m: float = 0.050
    yaw_deg: float = 35.0
    tilt_deg: float = 10.0
    offset_m: float = 0.010


def drop_poses(
    drop: DropSpec, line_m: Float64[ndarray, "n 3"], stirrups: int, random: np.random.Generator
) -> list[Pose]:
    """Return the poses in which ``stirrups`` of centreline ``line_m`` are let go, the lowest first."""
    hoop_middle_m = _hoop_middle_m(line_m)
    poses = []
    for level in range(stirrups):
        turn = _drawn_turn(drop, random)
        over_m = np.array(
            [*random.uniform(-drop.offset_m, drop.offset_m, 2), drop.first_m + drop.spacing_m * level]
        )
        swung_m = placed_m(hoop_middle_m[None], Pose((0.0, 0.0, 0.0), turn))[0]
        x, y, z = (float(value) for value in over_m - swung_m)
        poses.append(Pose((x, y, z), turn))
    return poses


def centred(poses: Sequence[Pose], line_m: Float64[ndarray, "n 3"]) -> tuple[Pose, ...]:
    """Return the heap with the middle of its bounding box, along x and y, over the origin."""
    points_m = np.concatenate([placed_m(line_m, pose) for pose in poses])
    middle_x, middle_y, _ = ((points_m.min(axis=0) + points_m.max(axis=0)) / 2).tolist()
    return tuple(
        Pose(
            (pose.position_m[0] - middle_x, pose.position_m[1] - middle_y, pose.position_m[2]),
            pose.quaternion_wxyz,
        )
        for pose in poses
    )


def reach_m(lines_m: Sequence[Float64[ndarray, "n 3"]], radius_m: float) -> float:
    """Return how far from the origin the steel reaches along x or y, metres."""
    return float(max(np.abs(line[:, :2]).max() for line in lines_m) + radius_m)


def height_m(lines_m: Sequence[Float64[ndarray, "n 3"]], radius_m: float) -> float:
    """Return how high the steel reaches, metres."""
    return float(max(line[:, 2].max() for line in lines_m) + radius_m)


def tilts_deg(poses: Sequence[Pose]) -> list[float]:
    """Return by how many degrees the plane of each hoop is off the level."""
    upright = np.array([[0.0, 0.0, 1.0]])
    planes = [placed_m(upright, Pose((0.0, 0.0, 0.0), pose.quaternion_wxyz))[0] for pose in poses]
    return [float(np.rad2deg(np.arccos(min(1.0, abs(plane[2]))))) for plane in planes]


def free_markers(lines_m: Sequence[Float64[ndarray, "n 3"]], radius_m: float, board: BoardSpec) -> tuple[int, ...]:
    """Return the markers that no steel covers as seen from above, nor their quiet zone of one module."""
    points_m = np.concatenate([resampled_m(line, _SAMPLE_M)[:, :2] for line in lines_m])
    quiet_m = board.marker_side_m / MARKER_MODULES
    free = []
    for marker_id, corners_m in marker_corners_m(board).items():
        low_m, high_m = corners_m[:, :2].min(axis=0) - quiet_m, corners_m[:, :2].max(axis=0) + quiet_m
        outside_m = np.maximum(np.maximum(low_m - points_m, points_m - high_m), 0.0)
        if np.linalg.norm(outside_m, axis=1).min() > radius_m:
            free.append(marker_id)
    return tuple(free)


def _drawn_turn(drop: DropSpec, random: np.random.Generator) -> tuple[float, float, float, float]:
    """Return a turn w x y z: which face lies down, then the yaw, then the tilt."""
    face = _about((1.0, 0.0, 0.0), 180.0 * random.integers(2))
    yaw = _about((0.0, 0.0, 1.0), random.uniform(-drop.yaw_deg, drop.yaw_deg) + 180.0 * random.integers(2))
    hinge = random.uniform(0.0, 2 * np.pi)
    tilt = _about((np.cos(hinge), np.sin(hinge), 0.0), random.uniform(0.0, drop.tilt_deg))
    w, x, y, z = (float(value) for value in _product(tilt, _product(yaw, face)))
    return (w, x, y, z)


def _about(axis: tuple[float, float, float], angle_deg: float) -> Float64[ndarray, " 4"]:
    half = np.deg2rad(angle_deg) / 2
    return np.array([np.cos(half), *(np.sin(half) * np.array(axis))])


def _product(last: Float64[ndarray, " 4"], first: Float64[ndarray, " 4"]) -> Float64[ndarray, " 4"]:
    """Return the quaternion that turns as ``first`` and then as ``last``."""
    scalar = last[0] * first[0] - last[1:] @ first[1:]
    vector = last[0] * first[1:] + first[0] * last[1:] + np.cross(last[1:], first[1:])
    return np.array([scalar, *vector])


def _hoop_middle_m(line_m: Float64[ndarray, "n 3"]) -> Float64[ndarray, " 3"]:
    """Return the middle of the hoop, which the hooks draw the centroid away from."""
    middle: Float64[ndarray, " 3"] = (line_m.min(axis=0) + line_m.max(axis=0)) / 2
    return middle
