"""Plain solids as closed triangle meshes, counter-clockwise from outside; world frame, metres."""

from __future__ import annotations

import numpy as np

from dataset_builder.model import Mesh

Point = tuple[float, float, float]

_BOX_FACES = [
    [0, 2, 3], [0, 3, 1],  # x low
    [4, 5, 7], [4, 7, 6],  # x high
    [0, 1, 5], [0, 5, 4],  # y low
    [2, 6, 7], [2, 7, 3],  # y high
    [0, 4, 6], [0, 6, 2],  # z low
    [1, 3, 7], [1, 7, 5],  # z high
]  # fmt: skip


def box(low_m: Point, high_m: Point) -> Mesh:
    """Return the box between two opposite corners."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float64)
    low, high = np.array(low_m), np.array(high_m)
    return Mesh(low + corners * (high - low), np.array(_BOX_FACES, dtype=np.int32))


def turned_box(middle_m: Point, size_m: Point, turn_deg: float) -> Mesh:
    """Return a box of ``size_m`` about ``middle_m``, turned about the vertical."""
    half = np.array(size_m) / 2
    upright = box((-half[0], -half[1], -half[2]), (half[0], half[1], half[2]))
    cosine, sine = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
    rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return Mesh(upright.vertices_m @ rotation.T + np.array(middle_m), upright.faces)


def cylinder(foot_m: Point, radius_m: float, height_m: float, segments: int = 64) -> Mesh:
    """Return an upright cylinder on ``foot_m``, the middle of its lower face."""
    angle = np.arange(segments) * 2 * np.pi / segments
    rim = radius_m * np.stack([np.cos(angle), np.sin(angle), np.zeros(segments)], axis=1)
    up = np.array([0.0, 0.0, height_m])
    vertices = np.array(foot_m) + np.concatenate([rim, rim + up, [np.zeros(3), up]])
    here = np.arange(segments)
    beside = (here + 1) % segments
    faces = np.concatenate(
        [
            np.stack([here, beside, beside + segments], axis=1),
            np.stack([here, beside + segments, here + segments], axis=1),
            np.stack([np.full(segments, 2 * segments), beside, here], axis=1),
            np.stack([np.full(segments, 2 * segments + 1), here + segments, beside + segments], axis=1),
        ]
    )
    return Mesh(vertices, faces.astype(np.int32))
