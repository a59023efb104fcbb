"""Triangle meshes of ribbed and plain reinforcing bars, swept along a centreline.

The surface of a bar is parametrised by the angle ``theta`` around its axis and the arc length ``s`` along it. Two
opposite rows of transverse ribs are separated by two longitudinal ribs (seams) at ``theta`` = 0 and pi. The rings
of the mesh are inclined with the ribs, so that every rib edge is an edge of the mesh and is represented exactly
with few triangles.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.model import Mesh
from dataset_builder.scene.shapes.solids import tube_faces


@dataclass(frozen=True)
class RibPattern:
    """Rib dimensions of a bar in nominal diameters d; ASTM A615 requires spacing <= 0.7 d, angle >= 45 degrees.

    ``angle_deg`` is the angle between rib and bar axis, ``seam_half_deg`` the angular half width of a longitudinal
    rib seen from the axis, ``segments_per_row`` the number of mesh segments across one of the two rows.
    """

    spacing: float = 0.68
    height: float = 0.055
    base_width: float = 0.24
    top_width: float = 0.09
    angle_deg: float = 60.0
    seam_height: float = 0.025
    seam_half_deg: float = 10.0
    segments_per_row: int = 10


STANDARD_RIBS = RibPattern()


def ribbed_bar_mesh(
    centreline_m: Float64[ndarray, "n 3"], diameter_m: float, ribs: RibPattern = STANDARD_RIBS
) -> Mesh:
    """Return the watertight mesh of a ribbed bar along ``centreline_m`` (world or local frame, metres).

    Both ends are flat and closed. The mean cross-section equals that of the nominal ``diameter_m``. Bends must be
    finely sampled; the seams follow a parallel-transported frame along the line. Raises ``ValueError`` for a
    diameter that is not positive and for an invalid centreline.
    """
    axis = _Axis.from_points(np.asarray(centreline_m, dtype=np.float64))
    if diameter_m <= 0:
        raise ValueError(f"diameter_m is {diameter_m}, expected a positive length")
    theta = _ring_angles(ribs)
    ring_position = _ring_positions(axis.length_m / diameter_m, ribs)
    radius_m = diameter_m * (_core_ratio(ribs) + _rib_height(ring_position[:, None], theta, ribs))
    s_m = diameter_m * _inclined_ring_positions(ring_position, theta, ribs)
    side = axis.surface_points_m(s_m, theta, radius_m)
    vertices = np.concatenate([side.reshape(-1, 3), axis.points_m[[0, -1]]])
    return Mesh(vertices, tube_faces(len(ring_position), len(theta)))


def plain_bar_mesh(centreline_m: Float64[ndarray, "n 3"], diameter_m: float, segments: int = 24) -> Mesh:
    """Return the watertight mesh of a bar without ribs, for bars so distant that ribs are a fraction of a pixel.

    There is a ring at every point of ``centreline_m`` (metres); both ends are flat and closed. The cross-section
    is a polygon of ``segments`` corners with the area of the nominal section. Raises ``ValueError`` as
    ``ribbed_bar_mesh``.
    """
    axis = _Axis.from_points(np.asarray(centreline_m, dtype=np.float64))
    if diameter_m <= 0:
        raise ValueError(f"diameter_m is {diameter_m}, expected a positive length")
    theta = np.arange(segments) * 2 * np.pi / segments
    radius_m = plain_outer_radius_m(diameter_m, segments)
    s_m = np.repeat(axis.arc_m[:, None], segments, axis=1)
    side = axis.surface_points_m(s_m, theta, np.full_like(s_m, radius_m))
    vertices = np.concatenate([side.reshape(-1, 3), axis.points_m[[0, -1]]])
    return Mesh(vertices, tube_faces(len(axis.points_m), segments))


def plain_outer_radius_m(diameter_m: float, segments: int = 24) -> float:
    """Return the circumradius, metres, of the regular polygon with the area of a circle of ``diameter_m``."""
    wedge = 2 * np.pi / segments
    return float(diameter_m / 2 * np.sqrt(wedge / np.sin(wedge)))


def outer_radius_m(diameter_m: float, ribs: RibPattern = STANDARD_RIBS) -> float:
    """Return the maximum distance of the surface of a straight bar from its axis: core plus rib, metres."""
    return diameter_m * (_core_ratio(ribs) + max(ribs.height, ribs.seam_height))


def _ring_angles(ribs: RibPattern) -> Float64[ndarray, " k"]:
    """Return the angles of one ring, radians: four per seam (foot, crown, crown, foot), even steps in the rows."""
    foot = np.deg2rad(ribs.seam_half_deg)
    row = np.linspace(foot, np.pi - foot, ribs.segments_per_row + 1)
    half = np.concatenate([[-0.4 * foot, 0.4 * foot], row])
    return np.concatenate([half, half + np.pi])


def _ring_positions(length: float, ribs: RibPattern) -> Float64[ndarray, " r"]:
    """Return the ring positions along a bar of ``length`` diameters: its ends and every rib edge, in diameters."""
    edges = np.array([-ribs.base_width, -ribs.top_width, ribs.top_width, ribs.base_width]) / 2
    # The ribs of the second row are offset by half a spacing.
    rib_centres = np.arange(-1, 2 * length / ribs.spacing + 2) * ribs.spacing / 2
    positions = np.unique((rib_centres[:, None] + edges).ravel())
    sliver = 0.02
    inside = positions[(positions > sliver) & (positions < length - sliver)]
    return np.concatenate([[0.0], inside, [length]])


def _rib_height(
    along: Float64[ndarray, "r 1"], theta: Float64[ndarray, " k"], ribs: RibPattern
) -> Float64[ndarray, "r k"]:
    """Return the height of the surface above the core, in diameters."""
    foot = np.deg2rad(ribs.seam_half_deg)
    from_seam = np.abs((theta + np.pi / 2) % np.pi - np.pi / 2)
    seam = ribs.seam_height * np.clip((foot - from_seam) / (0.6 * foot), 0.0, 1.0)
    # Crescent-shaped ribs: highest in the middle of a row, zero at the seams.
    crescent = ribs.height * np.sin(np.pi * np.clip((theta % np.pi - foot) / (np.pi - 2 * foot), 0.0, 1.0))
    second_row = theta % (2 * np.pi) > np.pi
    offset = np.where(second_row, ribs.spacing / 2, 0.0)
    return np.asarray(seam + crescent * _rib_profile(along + offset, ribs))


def _rib_profile(along: Float64[ndarray, "*n"], ribs: RibPattern) -> Float64[ndarray, "*n"]:
    """Return the trapezoidal profile of ribs at 0, spacing, 2 spacing ...: 1 on the ribs, 0 between them."""
    from_centre = np.abs((along + ribs.spacing / 2) % ribs.spacing - ribs.spacing / 2)
    flank = (ribs.base_width - ribs.top_width) / 2
    return np.asarray(np.clip((ribs.base_width / 2 - from_centre) / flank, 0.0, 1.0))


@cache
def _core_ratio(ribs: RibPattern) -> float:
    """Return the core radius in diameters for which the bar including its ribs has the nominal cross-section.

    The mean area is quadratic in the core radius. Inclining the rings does not change the volume.
    """
    theta = _ring_angles(ribs)
    samples = (np.arange(400)[:, None] + 0.5) / 400 * ribs.spacing
    height = _rib_height(samples, theta, ribs)
    following = np.roll(height, -1, axis=1)
    wedge = np.sin(np.diff(theta, append=theta[0] + 2 * np.pi)) / 2
    a = wedge.sum()
    b = (wedge * (height + following)).sum(axis=1).mean()
    c = (wedge * height * following).sum(axis=1).mean() - np.pi / 4
    return float((-b + np.sqrt(b * b - 4 * a * c)) / (2 * a))


def _inclined_ring_positions(
    ring_position: Float64[ndarray, " r"], theta: Float64[ndarray, " k"], ribs: RibPattern
) -> Float64[ndarray, "r k"]:
    """Return arc lengths, in diameters, of rings inclined to the rib angle; the tilt vanishes at the flat ends."""
    lead = 0.5 / np.tan(np.deg2rad(ribs.angle_deg))
    distance_to_end = np.minimum(ring_position, ring_position[-1] - ring_position)
    # Reducing the tilt over twice the lead keeps neighbouring rings from crossing.
    tilt = lead * np.clip(distance_to_end / (2 * lead), 0.0, 1.0)
    return np.asarray(ring_position[:, None] - tilt[:, None] * np.cos(theta))


@dataclass(frozen=True, eq=False)
class _Axis:
    """Centreline with twist-free (parallel-transported) frames; theta is measured from ``normal``."""

    points_m: Float64[ndarray, "n 3"]
    arc_m: Float64[ndarray, " n"]
    tangent: Float64[ndarray, "n 3"]
    normal: Float64[ndarray, "n 3"]

    @classmethod
    def from_points(cls, points_m: Float64[ndarray, "n 3"]) -> _Axis:
        steps = np.diff(points_m, axis=0)
        lengths = np.linalg.norm(steps, axis=1)
        if len(lengths) == 0 or lengths.min() <= 0:
            raise ValueError("a centreline needs two or more points, none repeated in a row")
        directions = steps / lengths[:, None]
        if ((directions[:-1] * directions[1:]).sum(axis=1) < -0.999).any():
            raise ValueError("the centreline turns back on itself at one of its points")
        tangent = np.concatenate([directions[:1], directions[:-1] + directions[1:], directions[-1:]])
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        return cls(points_m, np.concatenate([[0.0], np.cumsum(lengths)]), tangent, _transported_normals(tangent))

    @property
    def length_m(self) -> float:
        return float(self.arc_m[-1])

    def surface_points_m(
        self,
        s_m: Float64[ndarray, "r k"],
        theta: Float64[ndarray, " k"],
        radius_m: Float64[ndarray, "r k"],
    ) -> Float64[ndarray, "r k 3"]:
        """Return the points at arc length ``s_m``, angle ``theta`` and ``radius_m`` from the centreline."""
        centre = self._interpolated(self.points_m, s_m)
        tangent = _unit(self._interpolated(self.tangent, s_m))
        normal = self._interpolated(self.normal, s_m)
        normal = _unit(normal - (normal * tangent).sum(axis=-1, keepdims=True) * tangent)
        binormal = np.cross(tangent, normal)
        outward = np.cos(theta)[:, None] * normal + np.sin(theta)[:, None] * binormal
        return np.asarray(centre + radius_m[..., None] * outward)

    def _interpolated(
        self, values: Float64[ndarray, "n 3"], s_m: Float64[ndarray, "r k"]
    ) -> Float64[ndarray, "r k 3"]:
        return np.stack([np.interp(s_m, self.arc_m, column) for column in values.T], axis=-1)


def _transported_normals(tangent: Float64[ndarray, "n 3"]) -> Float64[ndarray, "n 3"]:
    """Return twist-free normals: each is the previous one under the smallest rotation between the tangents."""
    least_aligned = np.eye(3)[np.argmin(np.abs(tangent[0]))]
    normals = [_unit(np.cross(np.cross(tangent[0], least_aligned), tangent[0]))]
    for before, here in pairwise(tangent):
        normals.append(_rotate_between(normals[-1], before, here))
    return np.stack(normals)


def _rotate_between(
    vector: Float64[ndarray, " 3"], before: Float64[ndarray, " 3"], after: Float64[ndarray, " 3"]
) -> Float64[ndarray, " 3"]:
    """Return ``vector`` rotated by the smallest rotation that takes unit ``before`` to unit ``after``."""
    cross, cosine = np.cross(before, after), float(before @ after)
    rotated = vector + np.cross(cross, vector) + np.cross(cross, np.cross(cross, vector)) / (1 + cosine)
    return np.asarray(rotated)


def _unit(vectors: Float64[ndarray, "*n 3"]) -> Float64[ndarray, "*n 3"]:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
