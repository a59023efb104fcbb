"""What a bar's mesh tells of the bar: its straight centreline and its diameter."""

from __future__ import annotations

import math

import numpy as np
import trimesh
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.model import ESTIMATED, Bar, Mesh

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
    # About a point near the mesh: a far origin would cancel digits.
    origin = mesh.vertices_m.mean(axis=0)
    body = trimesh.Trimesh(mesh.vertices_m - origin, mesh.faces)
    if not body.area > 0:
        raise ValueError("every triangle has zero area")
    direction = _principal_direction(body)
    closed = body.is_watertight and body.is_winding_consistent
    volume = abs(body.volume) if closed else 0.0
    solid = volume > _NO_VOLUME * body.area**1.5
    centroid = body.center_mass if solid else body.centroid
    offset = body.triangles - centroid
    along = offset @ direction
    low, high = float(along.min()), float(along.max())
    if solid:
        diameter = math.sqrt(4 * volume / (math.pi * (high - low)))
    else:
        distance = np.linalg.norm(offset - along[..., None] * direction, axis=-1).mean(axis=1)
        diameter = 2 * float(np.average(distance, weights=body.area_faces))
    ends = (_point(origin + centroid + low * direction), _point(origin + centroid + high * direction))
    return Bar(bar_id, ESTIMATED, diameter, ends)


def _principal_direction(body: trimesh.Trimesh) -> Float64[ndarray, " 3"]:
    """Return the unit direction of largest surface spread; tessellation does not weigh in."""
    offset = body.triangles - body.centroid
    total = offset.sum(axis=1)
    # The integral of x x^T over a triangle is area/12 (sum of v v^T over its corners + s s^T), s their sum.
    spread = np.einsum("n,nki,nkj->ij", body.area_faces, offset, offset)
    spread += np.einsum("n,ni,nj->ij", body.area_faces, total, total)
    direction: Float64[ndarray, " 3"] = np.linalg.eigh(spread)[1][:, -1]
    return direction if direction[np.argmax(np.abs(direction))] > 0 else -direction


def _point(value: Float64[ndarray, " 3"]) -> tuple[float, float, float]:
    x, y, z = value.tolist()
    return x, y, z
