"""Meshes of the bars of a cage: choice of ribbed or plain surfaces, meshes swept along axes, and their size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.assemblies.cage import CageBar
from dataset_builder.scene.model import Mesh
from dataset_builder.scene.shapes.bar_mesh import (
    RibPattern,
    outer_radius_m,
    plain_bar_mesh,
    plain_outer_radius_m,
    ribbed_bar_mesh,
)

MAX_RIBS_PER_ROW = 400
"""Largest number of ribs in one row of a ribbed bar; a longer bar (272 diameters or more) gets a plain surface.

When such a bar is wholly in view, it is about two pixels wide and its ribs project by a tenth of a pixel.
"""

MAX_RIBS_PER_CAGE = 12_000
"""Largest number of ribs of a cage; with more, all its bars get plain surfaces.

One rib with the space to the next takes 416 triangles, so this number takes five million.
"""

_PLAIN_BAR_SEGMENTS = 24
"""Segments round the circumference of a plain bar."""

_BEND_MARGIN_DIAMETERS = 1.0
"""Distance from a bend's end, in diameters, at which the cross-section is perpendicular to the axis again."""


def with_ribs_chosen(bars: Sequence[CageBar]) -> list[CageBar]:
    """Return the bars with ``ribs`` set by the limits per row and per cage."""
    ribs = [ribs_per_row(bar) if bar.ribs and bar.mesh is None else 0.0 for bar in bars]
    is_ribbed = [0 < count <= MAX_RIBS_PER_ROW for count in ribs]
    too_many = sum(count for count, ribbed in zip(ribs, is_ribbed, strict=True) if ribbed) > MAX_RIBS_PER_CAGE
    return [replace(bar, ribs=ribbed and not too_many) for bar, ribbed in zip(bars, is_ribbed, strict=True)]


def ribs_per_row(bar: CageBar) -> float:
    """Return the number of ribs in one row along the bar."""
    length_m = np.linalg.norm(np.diff(np.array(bar.bar.axis_m), axis=0), axis=1).sum()
    return float(length_m / bar.bar.diameter_m / RibPattern.spacing)


def bar_reach_m(bar: CageBar) -> float:
    """Return the largest distance of a bar's surface from its axis, metres; 0 for a bar with a mesh of its own."""
    if bar.mesh is not None:
        return 0.0
    diameter_m = bar.bar.diameter_m
    return outer_radius_m(diameter_m) if bar.ribs else plain_outer_radius_m(diameter_m, _PLAIN_BAR_SEGMENTS)


def estimated_triangles(bar: CageBar) -> int:
    """Return an upper estimate of the number of triangles of a bar's mesh."""
    if bar.mesh is not None:
        return len(bar.mesh.faces)
    if bar.ribs:  # A bar has two rows of ribs, with four mesh rings per rib.
        ring = 2 * (RibPattern.segments_per_row + 3)
        return int((8 * ribs_per_row(bar) + 24) * 2 * ring)
    return (3 * len(bar.bar.axis_m) + 2) * 2 * _PLAIN_BAR_SEGMENTS


def bar_mesh(bar: CageBar) -> Mesh:
    """Return the bar's own mesh, or one swept along its axis (world, metres)."""
    if bar.mesh is not None:
        return bar.mesh
    line_m = _with_points_near_bends(np.array(bar.bar.axis_m), bar.bar.diameter_m)
    if bar.ribs:
        return ribbed_bar_mesh(line_m, bar.bar.diameter_m)
    return plain_bar_mesh(line_m, bar.bar.diameter_m, _PLAIN_BAR_SEGMENTS)


def _with_points_near_bends(line_m: Float64[ndarray, "n 3"], diameter_m: float) -> Float64[ndarray, "k 3"]:
    """Return the line with extra points on its long legs, one diameter from each inner end.

    A mesh is swept with the mean direction at each point, interpolated in between. The extra points confine
    the rotation of the cross-section at a bend's end or a sharp corner to one diameter, so that the rest of
    the leg is straight.
    """
    pieces = [line_m[:1]]
    last = len(line_m) - 2
    for leg, (a, b) in enumerate(pairwise(line_m)):
        length_m = float(np.linalg.norm(b - a))
        if length_m > 4 * _BEND_MARGIN_DIAMETERS * diameter_m:
            step = (b - a) / length_m * _BEND_MARGIN_DIAMETERS * diameter_m
            pieces += [(a + step)[None]] if leg > 0 else []
            pieces += [(b - step)[None]] if leg < last else []
        pieces.append(b[None])
    return np.concatenate(pieces)
