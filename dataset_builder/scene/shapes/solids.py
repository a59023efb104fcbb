"""Simple solids as closed triangle meshes, counter-clockwise seen from outside; metres."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int32
from numpy import ndarray

from dataset_builder.scene.model import Mesh, WorldMesh

Point = tuple[float, float, float]

_BOX_FACES = [
    [0, 3, 2], [0, 1, 3],  # x low
    [4, 7, 5], [4, 6, 7],  # x high
    [0, 5, 1], [0, 4, 5],  # y low
    [2, 7, 6], [2, 3, 7],  # y high
    [0, 6, 4], [0, 2, 6],  # z low
    [1, 7, 3], [1, 5, 7],  # z high
]  # fmt: skip


def box(corner_m: Point, opposite_m: Point) -> Mesh:
    """Return the axis-aligned box between two opposite corners, in any order."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float64)
    low, high = np.minimum(corner_m, opposite_m), np.maximum(corner_m, opposite_m)
    return Mesh(low + corners * (high - low), np.array(_BOX_FACES, dtype=np.int32))


def rotated_box(middle_m: Point, size_m: Point, turn_deg: float) -> Mesh:
    """Return a box of ``size_m`` centred at ``middle_m``, rotated about the vertical by ``turn_deg``."""
    half = np.array(size_m) / 2
    upright = box((-half[0], -half[1], -half[2]), (half[0], half[1], half[2]))
    return transformed(upright, rotation_about_z(turn_deg), middle_m)


def cylinder(foot_m: Point, radius_m: float, height_m: float, segments: int = 64) -> Mesh:
    """Return an upright cylinder; ``foot_m`` is the centre of its lower face."""
    angle = np.arange(segments) * 2 * np.pi / segments
    rim = radius_m * np.stack([np.cos(angle), np.sin(angle), np.zeros(segments)], axis=1)
    up = np.array([0.0, 0.0, height_m])
    vertices = np.array(foot_m) + np.concatenate([rim, rim + up, [np.zeros(3), up]])
    return Mesh(vertices, tube_faces(2, segments))


def ring_faces(rings: int, segments: int, *, closed: bool = False) -> Int32[ndarray, "f 3"]:
    """Return the triangles between neighbouring rings of ``segments`` vertices each.

    If ``closed``, the last ring is connected to the first one.
    """
    count = rings if closed else rings - 1
    ring, segment = (grid.ravel() for grid in np.indices((count, segments), dtype=np.int32))
    beside, above = (segment + 1) % segments, (ring + 1) % rings * segments
    here, diagonal = ring * segments + segment, above + beside
    lower = np.stack([here, ring * segments + beside, diagonal], axis=1)
    return np.concatenate([lower, np.stack([here, diagonal, above + segment], axis=1)])


def tube_faces(rings: int, segments: int) -> Int32[ndarray, "f 3"]:
    """Return the triangles of a tube of vertex rings, closed by fans around the last two vertices."""
    rim = np.arange(segments, dtype=np.int32)
    rim_next = (rim + 1) % segments
    first_centre, last_centre, last_ring = rings * segments, rings * segments + 1, (rings - 1) * segments
    first_cap = np.stack([np.full_like(rim, first_centre), rim_next, rim], axis=1)
    last_cap = np.stack([np.full_like(rim, last_centre), last_ring + rim, last_ring + rim_next], axis=1)
    return np.concatenate([ring_faces(rings, segments), first_cap, last_cap])


def lathe(profile_m: Float64[ndarray, "n 2"], segments: int = 32) -> Mesh:
    """Return the solid of revolution about the z axis of a closed outline of (radius, height) points.

    The outline is counter-clockwise with the radius to the right and the height up. Its first point is not
    repeated, and all radii are positive.
    """
    count = len(profile_m)
    angle = np.arange(segments)[:, None] * 2 * np.pi / segments
    radius, height = profile_m[:, 0], np.broadcast_to(profile_m[:, 1], (segments, count))
    vertices = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=-1).reshape(-1, 3)
    turn, point = (grid.ravel() for grid in np.meshgrid(np.arange(segments), np.arange(count), indexing="ij"))
    here, up = turn * count + point, turn * count + (point + 1) % count
    beside, beside_up = (np.roll(corner, -count) for corner in (here, up))
    faces = np.concatenate([np.stack([here, beside, beside_up], 1), np.stack([here, beside_up, up], 1)])
    return Mesh(vertices, faces.astype(np.int32))


def transformed(
    mesh: Mesh, world_from_local: Float64[ndarray, "3 3"], at_m: Point | Float64[ndarray, " 3"]
) -> Mesh:
    """Return ``mesh`` mapped by the matrix ``world_from_local`` and then translated by ``at_m``, metres."""
    return Mesh(mesh.vertices_m @ world_from_local.T + np.asarray(at_m), mesh.faces)


def rotation_about_z(turn_deg: float) -> Float64[ndarray, "3 3"]:
    """Return the matrix of a rotation about the z axis, counter-clockwise seen from above."""
    cosine, sine = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def merge_meshes(meshes: Sequence[Mesh]) -> Mesh:
    """Return the meshes concatenated into one, in order."""
    starts = np.cumsum([0, *(len(mesh.vertices_m) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
    return Mesh(np.concatenate([mesh.vertices_m for mesh in meshes]), np.concatenate(faces).astype(np.int32))


def world_mesh(meshes: Sequence[Mesh], bar_ids: Sequence[int]) -> WorldMesh:
    """Return the meshes in the world frame, each with its bar id, as one mesh in order."""
    merged = merge_meshes(meshes)
    face_bar_id = np.repeat(np.array(bar_ids, np.uint16), [len(mesh.faces) for mesh in meshes])
    return WorldMesh(merged.vertices_m, merged.faces, face_bar_id)
