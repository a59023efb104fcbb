"""Tie-wire props: double loops of thin wire around the two bars of a crossing, with free ends."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.model import Part, surface
from dataset_builder.scene.shapes.bar_mesh import plain_bar_mesh
from dataset_builder.scene.shapes.solids import merge_meshes
from dataset_builder.scene.variants.placement import GAP_M, Capsules, Crossing, PlacementContext, find_crossings

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
    around = capsules.overlapping(line_m.min(axis=0) - WIRE_M, line_m.max(axis=0) + WIRE_M)
    return bool(capsules.select(around).clearance_m(dense_m) > CORNER_THICKENING * WIRE_M / 2)


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
