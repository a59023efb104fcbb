"""Supports of generated cages: blocks of mortar under steel that does not stand on the ground.

They keep the cover of the concrete below a beam, a slab or a footing, and belong to the cage: they are no variant.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.model import Part, surface
from dataset_builder.scene.shapes.solids import box, merge_meshes
from dataset_builder.scene.variants.placement import GAP_M, Capsules, PlacementContext

LEAST_COVER_M = 0.012
"""Height of the lowest steel from which a cage has blocks; cages below it stand or lie on the ground."""
BLOCK_HALF_M = 0.02
SPACING_M = 0.7
"""Half the width of a block, and the largest distance of the places where blocks are sought, along each side."""
_REACH_M = 0.35
"""Largest distance of a block from its place."""
_LAYER_M = 0.012
"""Height above the lowest steel up to which bars are supported."""
_MAX_SLOPE = 0.1
"""Largest rise per length of a supported part of a bar: a block below a bend would carry nothing."""
_SAMPLE_M = 0.02
_CLEAR_M = 4e-4
"""Distance of the points along bars at which a block is tried, and the least distance of a block from steel."""


def supports(context: PlacementContext) -> tuple[Part, ...]:
    """Return the blocks as one part, or nothing for a cage that stands or lies on the ground."""
    if context.low_m[2] < LEAST_COVER_M:
        return ()
    below = _points_below_bars(context)
    blocks: list[Float64[ndarray, " 3"]] = []
    for place_m in _places_m(context):
        distance_m = np.hypot(*(below[:, :2] - place_m).T)
        for index in np.argsort(distance_m, kind="stable"):
            top_m = below[index]
            if distance_m[index] > _REACH_M:
                break
            is_apart = all(np.abs(top_m - other)[:2].max() > 3 * BLOCK_HALF_M for other in blocks)
            if is_apart and _is_clear(context.capsules, top_m):
                blocks.append(top_m)
                break
    meshes = [
        box((x - BLOCK_HALF_M, y - BLOCK_HALF_M, 1.5 * GAP_M), (x + BLOCK_HALF_M, y + BLOCK_HALF_M, z))
        for x, y, z in (block.tolist() for block in blocks)
    ]
    return (surface("supports", merge_meshes(meshes), "concrete"),) if meshes else ()


def _places_m(context: PlacementContext) -> Float64[ndarray, "n 2"]:
    """Return places for blocks: a grid over the footprint of the steel, from edge to edge."""
    axes: list[Float64[ndarray, " n"]] = []
    for low, high in zip(context.low_m[:2], context.high_m[:2], strict=True):
        inset = min(0.06, 0.25 * (high - low))
        axes.append(np.linspace(low + inset, high - inset, 1 + int(np.ceil((high - low - 2 * inset) / SPACING_M))))
    return np.asarray(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2))


def _points_below_bars(context: PlacementContext) -> Float64[ndarray, "n 3"]:
    """Return points below level bars of the lowest layer, at the height of the top of a block there."""
    capsules = context.capsules
    bottoms_m = np.minimum(capsules.a_m[:, 2], capsules.b_m[:, 2]) - capsules.radius_m
    lowest = capsules.select(bottoms_m < context.low_m[2] + _LAYER_M)
    points = [np.zeros((0, 3))]
    for a, b, radius_m in zip(lowest.a_m, lowest.b_m, lowest.radius_m, strict=True):
        # A bar that slopes is lower at one side of a block than above its middle.
        slope = abs(b[2] - a[2]) / max(float(np.hypot(*(b - a)[:2])), 1e-9)
        if slope > _MAX_SLOPE:
            continue
        count = max(2, int(np.linalg.norm(b - a) / _SAMPLE_M))
        along = a + np.linspace(0.0, 1.0, count)[:, None] * (b - a)
        points.append(along - [0.0, 0.0, radius_m + slope * BLOCK_HALF_M + 2 * _CLEAR_M])
    joined = np.concatenate(points)
    return np.asarray(joined[joined[:, 2] > 0.5 * context.low_m[2]])


def _is_clear(capsules: Capsules, top_m: Float64[ndarray, " 3"]) -> bool:
    """Return whether the upper part of a block is clear of all bars; none is lower."""
    at, down = np.linspace(-BLOCK_HALF_M, BLOCK_HALF_M, 9), np.linspace(-1.5 * _LAYER_M, 0.0, 5)
    grid = np.stack(np.meshgrid(at, at, down, indexing="ij"), axis=-1).reshape(-1, 3) + top_m
    near = capsules.select(capsules.overlapping(grid.min(axis=0), grid.max(axis=0)))
    return bool(near.clearance_m(grid) > _CLEAR_M)
