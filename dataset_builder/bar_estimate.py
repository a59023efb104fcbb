"""What a bar's mesh tells of the bar: its straight centreline and its diameter."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.mesh_tools import enclosed_volume, is_closed, weld
from dataset_builder.model import Bar, Mesh

# Of a surface's area to the power 3/2: a closed sheet of no thickness stays below, any wire far above.
_NO_VOLUME = 1e-9


def estimate_bar(bar_id: int, mesh: Mesh) -> Bar:
    """Return the bar that ``mesh`` (world metres) looks like, with role ``imported``.

    The axis is the straight line through the centroid along the principal direction, as long as the mesh
    is along it, and runs towards the positive side of its dominant world axis. The diameter is that of the
    cylinder of equal length and volume where the mesh is closed, else twice the surface's mean distance
    from the axis. A bent bar is described no better than by such a line.

    Raises ``ValueError`` where every triangle has zero area.
    """
    corners = mesh.vertices_m[mesh.faces]
    area, surface_centroid = _area_and_centroid(corners)
    if not area.sum() > 0:
        raise ValueError("every triangle has zero area")
    direction = _principal_direction(corners, area, surface_centroid)
    volume = abs(enclosed_volume(corners)) if is_closed(weld(mesh).faces) else 0.0
    solid = volume > _NO_VOLUME * area.sum() ** 1.5
    centroid = _volume_centroid(corners) if solid else surface_centroid
    along = (corners.reshape(-1, 3) - centroid) @ direction
    low, high = float(along.min()), float(along.max())
    if solid:
        diameter = math.sqrt(4 * volume / (math.pi * (high - low)))
    else:
        diameter = 2 * _mean_distance(corners, area, centroid, direction)
    ends = (centroid + low * direction, centroid + high * direction)
    return Bar(bar_id, "imported", diameter, (_point(ends[0]), _point(ends[1])))


def _area_and_centroid(
    corners: Float64[ndarray, "n 3 3"],
) -> tuple[Float64[ndarray, " n"], Float64[ndarray, " 3"]]:
    """Return each triangle's area and the centroid of the surface."""
    edges = corners[:, 1:] - corners[:, :1]
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / 2
    total = area.sum()
    return area, (area @ corners.mean(axis=1)) / total if total > 0 else corners.mean(axis=(0, 1))


def _principal_direction(
    corners: Float64[ndarray, "n 3 3"], area: Float64[ndarray, " n"], centroid: Float64[ndarray, " 3"]
) -> Float64[ndarray, " 3"]:
    """Return the unit direction of largest surface spread; tessellation does not weigh in."""
    offset = corners - centroid
    total = offset.sum(axis=1)
    # The integral of x x^T over a triangle is area/12 (sum of v v^T over its corners + s s^T), s their sum.
    spread = np.einsum("n,nki,nkj->ij", area, offset, offset) + np.einsum("n,ni,nj->ij", area, total, total)
    direction: Float64[ndarray, " 3"] = np.linalg.eigh(spread)[1][:, -1]
    return direction if direction[np.argmax(np.abs(direction))] > 0 else -direction


def _volume_centroid(corners: Float64[ndarray, "n 3 3"]) -> Float64[ndarray, " 3"]:
    """Return the centroid of the solid inside a closed surface."""
    anchor = corners.mean(axis=(0, 1))
    a, b, c = np.moveaxis(corners - anchor, 1, 0)
    volume = np.einsum("ij,ij->i", a, np.cross(b, c))
    # A tetrahedron's centroid is a quarter of the sum of its corners, one of which is the anchor.
    return np.asarray(anchor + volume @ (a + b + c) / (4 * volume.sum()))


def _mean_distance(
    corners: Float64[ndarray, "n 3 3"],
    area: Float64[ndarray, " n"],
    centroid: Float64[ndarray, " 3"],
    direction: Float64[ndarray, " 3"],
) -> float:
    """Return the area-weighted mean distance of the triangles' corners from the axis."""
    offset = corners - centroid
    across = offset - (offset @ direction)[..., None] * direction
    return float(np.average(np.linalg.norm(across, axis=-1).mean(axis=1), weights=area))


def _point(value: Float64[ndarray, " 3"]) -> tuple[float, float, float]:
    x, y, z = value.tolist()
    return x, y, z
