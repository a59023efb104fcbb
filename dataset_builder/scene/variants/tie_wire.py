"""Tie wire: a double loop of thin wire round the two bars of a crossing, with its ends twisted off."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.model import NOT_STEEL, Part
from dataset_builder.scene.shapes.bar_mesh import plain_bar_mesh
from dataset_builder.scene.shapes.solids import joined
from dataset_builder.scene.variants.placement import GAP_M, Capsules, Crossing, Site, crossings

WIRE_M = 0.0012
"""Diameter of annealed tie wire."""
SHARE = 0.4
"""Share of the crossings that are tied: fixers tie every second or third."""
FEWEST_TIES, MOST_TIES = 12, 300
PASSING_GAP_M = 0.002
"""Bars whose surfaces pass at more than this are not tied."""
TURNS = 2
STEP_DEG = 15.0
TAIL_M = 0.006
CORNER = 1.45
"""A swept wire is this much thicker where it turns by a right angle than where it is straight."""
SEGMENTS = 6


def tie_wire(site: Site) -> tuple[Part, ...]:
    """Return all ties as one part; none where nothing crosses. A tie that would meet a third bar is left out."""
    found = crossings(site.capsules, PASSING_GAP_M)
    random = site.random("tie-wire")
    tied = min(len(found), max(FEWEST_TIES, min(MOST_TIES, round(SHARE * len(found)))))
    lines = (_tie_line_m(found[k], site) for k in sorted(random.permutation(len(found))[:tied]))
    meshes = [plain_bar_mesh(line, WIRE_M, SEGMENTS) for line in lines if line is not None]
    return (Part("tie-wire", joined(meshes), NOT_STEEL, "black wire"),) if meshes else ()


def _tie_line_m(crossing: Crossing, site: Site) -> Float64[ndarray, "n 3"] | None:
    """Return the wire's centreline at a crossing: along either diagonal, its ends to either side, as is clear."""
    capsules = site.capsules
    directions = [capsules.b_m[k] - capsules.a_m[k] for k in crossing.pieces]
    u, v = (direction / np.linalg.norm(direction) for direction in directions)
    for diagonal in sorted((u + v, u - v), key=lambda candidate: float(np.linalg.norm(candidate))):
        for side in (1, -1):
            line_m = _loop_m(crossing, (u, v), side * diagonal / np.linalg.norm(diagonal), capsules)
            if line_m[:, 2].min() > GAP_M + WIRE_M and _is_clear(line_m, capsules):
                return line_m
    return None


def _is_clear(line_m: Float64[ndarray, "n 3"], capsules: Capsules) -> bool:
    """Tell whether the wire, thicker at its corners, meets neither the bars it holds nor any other."""
    dense_m = np.concatenate([line_m, (line_m[1:] + line_m[:-1]) / 2])
    around = capsules.near(line_m.min(axis=0) - WIRE_M, line_m.max(axis=0) + WIRE_M)
    return bool(capsules.kept(around).clearance_m(dense_m) > CORNER * WIRE_M / 2)


def _loop_m(
    crossing: Crossing,
    directions: tuple[Float64[ndarray, " 3"], Float64[ndarray, " 3"]],
    w: Float64[ndarray, " 3"],
    capsules: Capsules,
) -> Float64[ndarray, "n 3"]:
    """Return turns of wire in planes that hold the diagonal ``w`` and the shortest way from bar to bar.

    Those planes cut the bars, thickened by the wire, in two ellipses. The wire follows their common convex hull
    and steps aside by more than its diameter with each turn.
    """
    first_m, second_m = crossing.points_m
    n = (second_m - first_m) / np.linalg.norm(second_m - first_m)
    m = np.cross(w, n)
    middle_m = (first_m + second_m) / 2
    radii_m = capsules.radius_m[list(crossing.pieces)]
    radii_m = radii_m + CORNER * WIRE_M / 2 + np.maximum(1.5e-4, 0.03 * radii_m)
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
    # Both ends leave along the diagonal, where the last turn ends.
    return np.concatenate([loop_m[:1] + TAIL_M * (w - 0.3 * n), loop_m, loop_m[-1:] + TAIL_M * (w + 0.3 * n)])
