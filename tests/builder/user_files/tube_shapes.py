"""Bent bars with exact centrelines, tessellated in several ways, and straight rods as mesh files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float64
from numpy import ndarray
from scipy.spatial import Delaunay

from dataset_builder.audit.geometry import polyline_distance_m
from dataset_builder.scene.model import Assembly, Mesh
from dataset_builder.scene.shapes.bending import bend_radius_m, bent_line_m
from dataset_builder.user_files.cage_file import load_cage, mesh_file_spec

DIAMETER_M = 0.012
Line = Float64[ndarray, "n 3"]


def _bent(corners: list[tuple[float, float, float]]) -> Line:
    return bent_line_m(np.array(corners), bend_radius_m(DIAMETER_M))


def _spiral() -> Line:
    angle = np.linspace(0, 6 * np.pi, 217)
    return np.stack([0.15 * np.cos(angle), 0.15 * np.sin(angle), 0.06 * angle / (2 * np.pi)], axis=1)


def _hoop() -> Line:
    """Return a closed stirrup: the first point is repeated at the end, in the middle of a leg."""
    corners = [(0.15, 0.0), (0.3, 0.0), (0.3, 0.2), (0.0, 0.2), (0.0, 0.0), (0.15, 0.0)]
    return _bent([(x, y, 0.0) for x, y in corners])


CENTRELINES_M: Mapping[str, Line] = {
    "U-bar": _bent([(0, 0.4, 0), (0, 0, 0), (0.2, 0, 0), (0.2, 0.4, 0)]),
    "stirrup with hooks": _bent(
        [(0.06, 0.06, 0), (0, 0, 0), (0.3, 0, 0.003), (0.3, 0.2, 0.006), (0, 0.2, 0.009), (0, -0.0, 0.014),
         (0.06, 0.06, 0.016)]
    ),
    "closed hoop": _hoop(),
    "spiral": _spiral(),
    "lapped": _bent([(0, 0, 0), (0.4, 0, 0), (0.5, 0.014, 0), (0.9, 0.014, 0)]),
    "cranked": _bent([(0, 0, 0), (0.3, 0, 0), (0.45, 0.15, 0.05), (0.8, 0.15, 0.05)]),
}  # fmt: skip
"""Exact centrelines, metres. A hoop ends at its first point."""


def swept(line_m: Line, facets: int, diameter_m: float = DIAMETER_M) -> Mesh:
    """Return the mitred tube along a line: polygons whose corners are on the circle; a hoop has no ends."""
    closed = bool(np.allclose(line_m[0], line_m[-1]))
    points_m = line_m[:-1] if closed else line_m
    ahead = np.roll(points_m, -1, axis=0) - points_m
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    if not closed:
        ahead[-1] = ahead[-2]
    side = np.cross(ahead[0], np.eye(3)[np.abs(ahead[0]).argmin()])
    angle = np.arange(facets) * 2 * np.pi / facets
    side /= np.linalg.norm(side)
    other = np.cross(ahead[0], side)
    ring_m = points_m[0] + diameter_m / 2 * (np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * other)
    before = ahead[-1] if closed else ahead[0]
    rings_m = []
    for point_m, here in zip(points_m, ahead, strict=True):
        plane = before + here  # The mitre plane; vertices move along the segment that ends in it.
        shift_m = (ring_m - point_m) @ plane / (before @ plane)
        ring_m = ring_m - shift_m[:, None] * before
        rings_m.append(ring_m)
        before = here
    count = len(points_m)
    grid = np.arange(count * facets).reshape(count, facets)
    following = np.roll(grid, -1, axis=0) if closed else grid[1:]
    here_ids = grid if closed else grid[:-1]
    if closed:  # Transport around the loop may turn the ring.
        gap = np.linalg.norm(rings_m[0] - ring_m[:1] - (points_m[0] - points_m[-1]), axis=1)
        following = following.copy()
        following[-1] = np.roll(grid[0], -int(gap.argmin()))
    a, b = here_ids, np.roll(here_ids, -1, axis=1)
    c, d = following, np.roll(following, -1, axis=1)
    faces = [np.stack([a, b, d], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)]
    if not closed:
        first, last = grid[0], grid[-1]
        fan = np.arange(1, facets - 1)
        faces.append(np.stack([np.full_like(fan, first[0]), first[fan + 1], first[fan]], 1))
        faces.append(np.stack([np.full_like(fan, last[0]), last[fan], last[fan + 1]], 1))
    return Mesh(np.concatenate(rings_m), np.concatenate(faces).astype(np.int32))


def divided(mesh: Mesh, edge_m: float = 0.02) -> Mesh:
    """Return triangles divided until no edge is longer than ``edge_m``; new vertices are on the old sides."""
    vertices, faces = trimesh.remesh.subdivide_to_size(mesh.vertices_m, mesh.faces, edge_m, max_iter=12)
    body = trimesh.Trimesh(vertices, faces)
    return Mesh(np.array(body.vertices), np.array(body.faces, dtype=np.int32))


def remeshed(line_m: Line, facets: int = 24) -> Mesh:
    """Return a tube of irregular triangles whose vertices are on the tube, about ``facets`` around, ends open.

    The tube is unrolled to a strip. The points of a jittered grid are triangulated there, repeated on both sides,
    that the triangulation closes around the tube.
    """
    fine = swept(line_m, 4 * facets).vertices_m
    rings_m = fine[: len(fine) // (4 * facets) * 4 * facets].reshape(-1, 4 * facets, 3)
    if np.allclose(line_m[0], line_m[-1]):
        rings_m = np.concatenate([rings_m, rings_m[:1]])
    arc_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line_m, axis=0), axis=1))])
    edge_m = np.pi * DIAMETER_M / facets
    rows = int(arc_m[-1] / edge_m)
    rng = np.random.default_rng(0)
    row, column = (grid.ravel().astype(float) for grid in np.indices((rows + 1, facets)))
    inner = (row > 0) & (row < rows)
    row[inner] += rng.uniform(-0.4, 0.4, inner.sum())
    column[inner] += rng.uniform(-0.4, 0.4, inner.sum())
    flat = np.stack([row, column], axis=1)
    three = np.concatenate([flat + np.array([0, turn * facets]) for turn in (-1, 0, 1)])
    simplices = Delaunay(three).simplices
    middle = three[simplices].mean(axis=1)[:, 1]
    faces = simplices[(middle >= 0) & (middle < facets)] % len(flat)
    at_m, angle = row / rows * arc_m[-1], np.floor(4 * column).astype(int) % (4 * facets)
    segment = np.clip(np.searchsorted(arc_m, at_m) - 1, 0, len(arc_m) - 2)
    share = ((at_m - arc_m[segment]) / np.diff(arc_m)[segment])[:, None]
    vertices_m = (1 - share) * rings_m[segment, angle] + share * rings_m[segment + 1, angle]
    return Mesh(vertices_m, faces.astype(np.int32))


def line_distance_m(first_m: Line, second_m: Line) -> float:
    """Return the largest distance of points of either polyline from the other, metres."""

    def dense(line_m: Line) -> Line:
        arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line_m, axis=0), axis=1))])
        at = np.linspace(0, arc[-1], 1000)
        return np.stack([np.interp(at, arc, column) for column in line_m.T], axis=1)

    return max(
        float(polyline_distance_m(dense(first_m), second_m).max()),
        float(polyline_distance_m(dense(second_m), first_m).max()),
    )


ALONG_X = np.array([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])


def rod(diameter_m: float, y_m: float = 0.0) -> trimesh.Trimesh:
    """Return a closed rod of 0.5 m along x."""
    body = trimesh.creation.cylinder(diameter_m / 2, 0.5, sections=64, transform=ALONG_X)
    body.apply_translation([0.25, y_m, 0.1])
    return body


RODS = tuple(rod(diameter_m, y_m) for diameter_m, y_m in ((0.016, 0.0), (0.010, 0.1), (0.020, 0.2)))


def concatenated(bodies: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Return bodies as one mesh that keeps their vertices and faces."""
    arrays = trimesh.util.append_faces([body.vertices for body in bodies], [body.faces for body in bodies])
    return trimesh.Trimesh(*arrays, process=False)


def obj_bytes(bodies: Sequence[trimesh.Trimesh], names: Sequence[str], per_metre: float = 1.0) -> bytes:
    """Return an OBJ file with an object for each body."""
    lines, start = ["mtllib missing.mtl"], 1
    for body, name in zip(bodies, names, strict=True):
        lines += [f"o {name}", *(f"v {x!r} {y!r} {z!r}" for x, y, z in (body.vertices * per_metre).tolist())]
        lines += ["vn 0 0 1", "usemtl steel", *(f"f {a}//1 {b}//1 {c}//1" for a, b, c in body.faces + start)]
        start += len(body.vertices)
    return "\n".join(lines).encode()


def load_content(folder: Path, name: str, content: bytes | str, unit: str | float = "m") -> Assembly:
    """Write a mesh file and return its cage."""
    (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
    return load_cage(mesh_file_spec(folder / name, unit))
