"""Exact ground truth by casting rays through pixel centres against the mesh of a scene, and the box of its steel.

Embree finds the first triangle that a ray hits; the depth is then computed in float64 from the intersection of the
ray with the plane of that triangle. The float32 distance of Embree deviates by up to 29 um at 16 m (measured).

Embree rounds rays to float32, so a ray may pass a triangle on the outline of the steel by a micrometre. If it also
runs almost along the plane of that triangle, they intersect away from the steel: this displaced six of the 232
million pixels of the pier, by up to 37 mm. Where the intersection is outside the triangle, the point of its edges
that is closest to the ray is taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int32, UInt16
from numpy import ndarray

from dataset_builder.scene.model import WorldMesh
from rebar_depth_bench.base.errors import BuildError
from rebar_depth_bench.data.rows import RenderedEye
from rebar_depth_bench.geometry.cameras import Camera, inverse_rigid, matrix_product
from rebar_depth_bench.geometry.segments import closest_points_m

_MISS = -1
_OUTSIDE_M = 1e-4
"""Largest distance of an intersection from its triangle; float32 explains up to 3 um at 17 m."""
_OUTSIDE_RATIO = 2e-6
"""The same distance as a part of a scene's size, for large ones: 16 times the resolution of float32."""


@dataclass(frozen=True, eq=False)
class RayHits:
    """Ray intersections: range in metres, cosine of incidence and bar id (infinity, 0, 0 without a hit)."""

    range_m: Float64[ndarray, " n"]
    cos_incidence: Float64[ndarray, " n"]
    bar_id: UInt16[ndarray, " n"]


class RayCaster:
    """Ray caster for the mesh of one scene."""

    def __init__(self, mesh: WorldMesh) -> None:
        # Commands that cast no rays, such as export, run without the extra ``build``.
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        a, b, c = np.moveaxis(mesh.vertices_m[mesh.faces], 1, 0)
        self._normal = np.cross(b - a, c - a)
        self._plane = np.einsum("ij,ij->i", self._normal, a)
        self._vertices_m, self._faces = mesh.vertices_m, mesh.faces
        self._face_bar_id = mesh.face_bar_id
        self._origin_m = mesh.vertices_m.mean(axis=0)
        local_m = np.ascontiguousarray(mesh.vertices_m - self._origin_m, dtype=np.float32)
        self._outside_m = max(_OUTSIDE_M, _OUTSIDE_RATIO * float(np.abs(local_m).max(initial=0.0)))
        self._scene = EmbreeScene(robust=True)
        TriangleMesh(
            self._scene,
            local_m,
            np.ascontiguousarray(mesh.faces, dtype=np.int32),
        )

    def cast(self, camera: Camera, rays_cam: Float64[ndarray, "h w 3"] | None = None) -> RenderedEye:
        """Return the ground truth of one camera without colour, casting one ray per pixel.

        ``rays_cam`` are the ``camera.rays()``, which take seconds on a distorted grid, if they are known. Their z
        is 1, so that the ray parameter is planar depth; nothing is resampled. Raises ``BuildError`` if a depth is
        not finite or negative.
        """
        rays_cam = camera.rays() if rays_cam is None else rays_cam
        world_from_cam = inverse_rigid(camera.cam_from_world)
        directions = matrix_product(rays_cam.reshape(-1, 3), world_from_cam[:3, :3].T)
        centre_m = world_from_cam[:3, 3]
        face = self._first_face(centre_m, directions)
        hit = face != _MISS
        depth_m = np.zeros(len(face))
        origins_m = np.broadcast_to(centre_m, (int(hit.sum()), 3))
        depth_m[hit] = self._ray_parameter(origins_m, directions[hit], face[hit])
        if not (np.isfinite(depth_m) & (depth_m >= 0)).all():
            raise BuildError("a ray does not intersect the face it hit in front of the camera")
        bars = np.zeros(len(face), np.uint16)
        bars[hit] = self._face_bar_id[face[hit]]
        bars = bars.reshape(camera.height, camera.width)
        return RenderedEye(camera, None, depth_m.astype(np.float32).reshape(bars.shape), bars > 0, bars)

    def hits(self, origins_m: Float64[ndarray, "n 3"], directions: Float64[ndarray, "n 3"]) -> RayHits:
        """Return the first intersection of each ray; world frame, directions of any length.

        The ranges are as exact as the depths of ``cast``. The cosine belongs to the angle to the face normal, for
        either side of the face.
        """
        face = self._first_face(origins_m, directions)
        hit = face != _MISS
        normal, along, length = self._normal[face[hit]], directions[hit], np.linalg.norm(directions[hit], axis=1)
        range_m, cos_incidence = np.full(len(face), np.inf), np.zeros(len(face))
        range_m[hit] = self._ray_parameter(origins_m[hit], along, face[hit]) * length
        cross = np.einsum("ij,ij->i", normal, along)
        cos_incidence[hit] = np.abs(cross) / (length * np.linalg.norm(normal, axis=1))
        bar_id = np.zeros(len(face), np.uint16)
        bar_id[hit] = self._face_bar_id[face[hit]]
        return RayHits(range_m, cos_incidence, bar_id)

    def bar_ids(
        self, origins_m: Float64[ndarray, "n 3"], directions: Float64[ndarray, "n 3"]
    ) -> UInt16[ndarray, " n"]:
        """Return the bar id of the first intersection of each ray, 0 without a hit; arguments as in ``hits``."""
        face = self._first_face(origins_m, directions)
        return np.where(face == _MISS, np.uint16(0), self._face_bar_id[face])

    def _first_face(
        self, centre_m: Float64[ndarray, "*n 3"], directions: Float64[ndarray, "n 3"]
    ) -> Int32[ndarray, " n"]:
        origins = np.broadcast_to((centre_m - self._origin_m).astype(np.float32), directions.shape)
        face: Int32[ndarray, " n"] = self._scene.run(
            np.ascontiguousarray(origins), directions.astype(np.float32), query="INTERSECT"
        )
        return face

    def _ray_parameter(
        self,
        origins_m: Float64[ndarray, "n 3"],
        directions: Float64[ndarray, "n 3"],
        face: Int32[ndarray, " n"],
    ) -> Float64[ndarray, " n"]:
        """Return the ray parameter of the intersection with each face, n . (a - c) / n . d, or with its edges."""
        normal = self._normal[face]
        to_plane = self._plane[face] - np.einsum("ij,ij->i", normal, origins_m)
        with np.errstate(divide="ignore", invalid="ignore"):
            parameter = to_plane / np.einsum("ij,ij->i", normal, directions)
            points_m = origins_m + parameter[:, None] * directions
            outside = ~_is_within(points_m, self._corners_m(face), normal, self._outside_m)
        corners_m = self._corners_m(face[outside])
        parameter[outside] = _closest_to_edges(origins_m[outside], directions[outside], corners_m)
        return np.asarray(parameter)

    def _corners_m(self, face: Int32[ndarray, " n"]) -> Float64[ndarray, "n 3 3"]:
        return np.asarray(self._vertices_m[self._faces[face]])


def _is_within(
    points_m: Float64[ndarray, "n 3"],
    corners_m: Float64[ndarray, "n 3 3"],
    normal: Float64[ndarray, "n 3"],
    tolerance_m: float,
) -> Bool[ndarray, " n"]:
    """Return whether each point of a triangle's plane is in the triangle or at most ``tolerance_m`` beside it."""
    within: Bool[ndarray, " n"] = np.isfinite(points_m).all(axis=1)
    for corner in range(3):
        start_m = corners_m[:, corner]
        inward = np.cross(normal, corners_m[:, (corner + 1) % 3] - start_m)
        distance = np.einsum("ij,ij->i", inward, points_m - start_m)
        within &= distance >= -tolerance_m * np.linalg.norm(inward, axis=1)
    return within


def _closest_to_edges(
    origins_m: Float64[ndarray, "n 3"], directions: Float64[ndarray, "n 3"], corners_m: Float64[ndarray, "n 3 3"]
) -> Float64[ndarray, " n"]:
    """Return the ray parameter at which each ray is closest to an edge of its triangle."""
    square = np.einsum("ij,ij->i", directions, directions)[:, None]
    corner_parameters = np.einsum("ikj,ij->ik", corners_m - origins_m[:, None], directions) / square
    ends_m = origins_m + corner_parameters.max(axis=1, keepdims=True) * directions
    closest = [
        closest_points_m(origins_m, ends_m, corners_m[:, corner], corners_m[:, (corner + 1) % 3])
        for corner in range(3)
    ]
    distance_m = np.stack([np.linalg.norm(on_edge - on_ray, axis=1) for on_ray, on_edge in closest], axis=1)
    on_edges_m = np.stack([on_edge for _, on_edge in closest], axis=1)
    nearest_m = on_edges_m[np.arange(len(origins_m)), distance_m.argmin(axis=1)]
    return np.asarray(np.einsum("ij,ij->i", nearest_m - origins_m, directions) / square[:, 0])


@dataclass(frozen=True)
class PixelBox:
    """Rectangle of pixels: rows ``top`` to ``bottom - 1``, columns ``left`` to ``right - 1``."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Index of the box in an image."""
        return slice(self.top, self.bottom), slice(self.left, self.right)


def steel_box(mask: Bool[ndarray, "h w"], margin_px: int) -> PixelBox | None:
    """Return the smallest box with all steel pixels and ``margin_px`` around them; None without steel.

    The box is cut off at the borders of the image.
    """
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    if not rows.size:
        return None
    height, width = mask.shape
    return PixelBox(
        top=max(int(rows[0]) - margin_px, 0),
        bottom=min(int(rows[-1]) + 1 + margin_px, height),
        left=max(int(columns[0]) - margin_px, 0),
        right=min(int(columns[-1]) + 1 + margin_px, width),
    )
