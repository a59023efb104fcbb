"""Tie-wire props: double loops of thin wire around the two bars of a crossing, with free ends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from dataset_builder.scene.model import Part, surface
from dataset_builder.scene.shapes.bar_mesh import plain_bar_mesh
from dataset_builder.scene.shapes.capsules import Capsules
from dataset_builder.scene.shapes.solids import merge_meshes
from dataset_builder.scene.variants.context import GAP_M, PlacementContext

WIRE_M = 0.0012
"""Diameter of annealed tie wire, metres."""
TIED_SHARE = 0.4
"""Fraction of the crossings that are tied; steel fixers tie every second or third one."""
MIN_TIES, MAX_TIES = 12, 300
"""Minimum (as far as there are crossings) and maximum number of ties."""
MAX_BAR_GAP_M = 0.002
"""Maximum distance between the surfaces of two bars that are tied, metres."""
TURNS = 2
STEP_DEG = 15.0
TAIL_M = 0.006
"""Length of the free ends along the diagonal of the crossing, metres."""
CORNER_THICKENING = 1.45
"""Ratio of the thickness of a swept wire at a right-angle turn to that of straight wire."""
SEGMENTS = 6
MIN_CROSSING_ANGLE_DEG = 30.0
"""Smallest angle between the axes of a crossing, degrees."""
_EPSILON = 1e-12
"""Smallest distance between the axes of a crossing, metres."""


def tie_wire(context: PlacementContext) -> tuple[Part, ...]:
    """Return all ties as one part, or no part if there are none; ties that would touch a bar are omitted."""
    crossings = find_crossings(context.capsules, MAX_BAR_GAP_M)
    rng = context.rng("tie-wire")
    tied = min(len(crossings), max(MIN_TIES, min(MAX_TIES, round(TIED_SHARE * len(crossings)))))
    lines = (_tie_line_m(crossings[k], context) for k in sorted(rng.permutation(len(crossings))[:tied]))
    meshes = [plain_bar_mesh(line, WIRE_M, SEGMENTS) for line in lines if line is not None]
    return (surface("tie-wire", merge_meshes(meshes), "black wire"),) if meshes else ()


def _tie_line_m(crossing: Crossing, context: PlacementContext) -> Float64[ndarray, "n 3"] | None:
    """Return the centreline of the tie at a crossing, metres, or None if none of the variants is clear.

    The variants are the two diagonals of the crossing, each with the free ends to either side.
    """
    capsules = context.capsules
    directions = [capsules.b_m[k] - capsules.a_m[k] for k in crossing.pieces]
    u, v = (direction / np.linalg.norm(direction) for direction in directions)
    for diagonal in sorted((u + v, u - v), key=lambda candidate: float(np.linalg.norm(candidate))):
        for side in (1, -1):
            line_m = _loop_m(crossing, (u, v), side * diagonal / np.linalg.norm(diagonal), capsules)
            if line_m[:, 2].min() > GAP_M + WIRE_M and _is_clear(line_m, capsules):
                return line_m
    return None


def _is_clear(line_m: Float64[ndarray, "n 3"], capsules: Capsules) -> bool:
    """Return whether the wire, including its thickening at corners, is clear of all bars."""
    dense_m = np.concatenate([line_m, (line_m[1:] + line_m[:-1]) / 2])
    return capsules.clearance_m(dense_m, WIRE_M) > CORNER_THICKENING * WIRE_M / 2


def _loop_m(
    crossing: Crossing,
    directions: tuple[Float64[ndarray, " 3"], Float64[ndarray, " 3"]],
    w: Float64[ndarray, " 3"],
    capsules: Capsules,
) -> Float64[ndarray, "n 3"]:
    """Return the turns of wire in planes spanned by the diagonal ``w`` and the shortest line between the bars.

    These planes cut the bars, enlarged by the wire, in two ellipses. The wire follows the convex hull of both and
    moves sideways by more than its diameter with each turn.
    """
    first_m, second_m = crossing.points_m
    n = (second_m - first_m) / np.linalg.norm(second_m - first_m)
    m = np.cross(w, n)
    middle_m = (first_m + second_m) / 2
    radii_m = capsules.radius_m[list(crossing.pieces)]
    radii_m = radii_m + CORNER_THICKENING * WIRE_M / 2 + np.maximum(1.5e-4, 0.03 * radii_m)
    turns = np.linspace(0.0, TURNS, round(TURNS * 360 / STEP_DEG) + 1)
    aside_m = (turns - TURNS / 2) * 1.4 * WIRE_M
    e = np.stack([np.cos(2 * np.pi * turns), np.sin(2 * np.pi * turns)], axis=1)
    hull_m = np.full((len(turns), 2), -np.inf)
    best = np.full(len(turns), -np.inf)
    for point_m, u, radius_m in zip(crossing.points_m, directions, radii_m, strict=True):
        centre_m = np.stack(
            [aside_m * (u @ w) / (u @ m), np.full(len(turns), float((point_m - middle_m) @ n))], axis=1
        )
        axes_m = np.array([radius_m / abs(u @ m), radius_m])
        touch_m = centre_m + axes_m**2 * e / np.linalg.norm(axes_m * e, axis=1)[:, None]
        support_m = (touch_m * e).sum(axis=1)
        hull_m = np.where((support_m > best)[:, None], touch_m, hull_m)
        best = np.maximum(best, support_m)
    loop_m = middle_m + hull_m[:, :1] * w + hull_m[:, 1:] * n + aside_m[:, None] * m
    # Both free ends leave along the diagonal, where the first turn starts and the last turn ends.
    return np.concatenate([loop_m[:1] + TAIL_M * (w - 0.3 * n), loop_m, loop_m[-1:] + TAIL_M * (w + 0.3 * n)])


@dataclass(frozen=True, eq=False)
class Crossing:
    """Crossing of two pieces (indices into the capsules), with the closest points of their axes."""

    pieces: tuple[int, int]
    points_m: tuple[Float64[ndarray, " 3"], Float64[ndarray, " 3"]]


def find_crossings(capsules: Capsules, gap_m: float) -> list[Crossing]:
    """Return the crossings of straight legs of different bars.

    Their surfaces are at most ``gap_m`` apart. Pieces of at most two diameters belong to bends and are omitted.
    """
    crossings = []
    legs = np.linalg.norm(capsules.b_m - capsules.a_m, axis=1) > 4 * capsules.radius_m
    low = np.minimum(capsules.a_m, capsules.b_m) - capsules.radius_m[:, None] - gap_m
    high = np.maximum(capsules.a_m, capsules.b_m) + capsules.radius_m[:, None] + gap_m
    for piece in np.flatnonzero(legs):
        later = legs & capsules.overlapping(low[piece], high[piece]) & (capsules.bar > capsules.bar[piece])
        others = np.flatnonzero(later)
        if len(others):
            crossings += _crossings_of(int(piece), others, capsules, gap_m)
    return crossings


def _crossings_of(piece: int, others: Int64[ndarray, " k"], capsules: Capsules, gap_m: float) -> list[Crossing]:
    u = capsules.b_m[piece] - capsules.a_m[piece]
    v = capsules.b_m[others] - capsules.a_m[others]
    w = capsules.a_m[piece] - capsules.a_m[others]
    uu, uv, vv, uw, vw = u @ u, v @ u, (v * v).sum(axis=1), w @ u, (w * v).sum(axis=1)
    squared_sine = 1.0 - uv**2 / (uu * vv)
    steep = squared_sine > np.sin(np.deg2rad(MIN_CROSSING_ANGLE_DEG)) ** 2
    across = np.where(steep, uu * vv - uv**2, 1.0)
    s, t = (uv * vw - vv * uw) / across, (uu * vw - uv * uw) / across
    # A closest point beyond the end of a piece is a crossing of the adjacent piece, or no crossing.
    inside = (s >= 0) & (s < 1) & (t >= 0) & (t < 1)
    on_piece = capsules.a_m[piece] + s[:, None] * u
    on_other = capsules.a_m[others] + t[:, None] * v
    apart = np.linalg.norm(on_piece - on_other, axis=1)
    close = (apart > _EPSILON) & (apart - capsules.radius_m[piece] - capsules.radius_m[others] <= gap_m)
    which = np.flatnonzero(steep & inside & close)
    return [Crossing((piece, int(others[k])), (on_piece[k], on_other[k])) for k in which]
