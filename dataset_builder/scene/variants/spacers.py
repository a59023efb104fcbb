"""Spacers that keep the concrete cover: plastic wheels on outer bars, blocks of mortar below generated cages.

The blocks are under steel that does not stand on the ground. They belong to the cage and are no variant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.cages.design import LEAST_COVER_M
from dataset_builder.scene.model import Mesh, Part, surface
from dataset_builder.scene.shapes.capsules import Capsules
from dataset_builder.scene.shapes.solids import box, lathe, merge_meshes, rotation_about_z, transformed
from dataset_builder.scene.variants.context import GAP_M, PlacementContext

BARS_PER_SPACER = 6
MIN_SPACERS, MAX_SPACERS = 4, 48
"""Minimum and maximum number of spacers requested for a scene."""
TRIES_PER_BAR = 12
"""Number of rng positions tried each time a bar is visited."""
MAX_VISITS_PER_BAR = 4
"""Number of times each bar is visited at most."""
SPOKES = 6
CIRCLE_SAMPLES = 32
"""Number of points around a wheel at which its clearance is measured, and of segments of its mesh."""


@dataclass(frozen=True)
class Wheel:
    """Dimensions of a wheel, metres: bore radius, rim radius, and width along the bar."""

    bore_m: float
    rim_m: float
    width_m: float


def wheel_for(envelope_m: float) -> Wheel:
    """Return the wheel for a bar of envelope radius ``envelope_m``; the bore is 2 % and 0.1 mm larger."""
    cover_m = float(np.clip(2.4 * envelope_m, 0.006, 0.04))
    width_m = float(np.clip(1.2 * envelope_m, 0.0025, 0.02))
    return Wheel(1.02 * envelope_m + 1e-4, envelope_m + cover_m, width_m)


def spacers(context: PlacementContext) -> tuple[Part, ...]:
    """Return wheels on bars along the outside of the steel, at positions clear of all other bars and wheels.

    Every bar is visited once before any bar is visited again.
    """
    rng = context.rng("spacers")
    count = int(np.clip(len(context.bars) // BARS_PER_SPACER, MIN_SPACERS, MAX_SPACERS))
    wheel_centres_m = np.empty((0, 3))
    parts: list[Part] = []
    for bar in np.tile(rng.permutation(len(context.bars)), MAX_VISITS_PER_BAR):
        if len(parts) == count:
            break
        placement = _find_position(context, int(bar), wheel_centres_m, rng)
        if placement is not None:
            wheel, at_m, direction = placement
            wheel_centres_m = np.concatenate([wheel_centres_m, at_m[None]])
            mesh = transformed(_wheel_mesh(wheel), _frame_along(direction), at_m)
            parts.append(surface(f"spacer-{len(parts)}", mesh, "orange plastic"))
    return tuple(parts)


def _find_position(
    context: PlacementContext, bar: int, wheel_centres_m: Float64[ndarray, "k 3"], rng: np.random.Generator
) -> tuple[Wheel, Float64[ndarray, " 3"], Float64[ndarray, " 3"]] | None:
    """Return wheel, position and bar direction for a spacer on ``bar``, or None if no position tried is clear."""
    pieces = np.flatnonzero(context.capsules.bar == bar)
    along = context.capsules.b_m[pieces] - context.capsules.a_m[pieces]
    lengths = np.linalg.norm(along, axis=1)
    wheel = wheel_for(float(context.capsules.radius_m[pieces[0]]))
    for _ in range(TRIES_PER_BAR):
        k = int(rng.choice(len(pieces), p=lengths / lengths.sum()))
        at_m = context.capsules.a_m[pieces[k]] + rng.uniform(0.02, 0.98) * along[k]
        direction = along[k] / lengths[k]
        if lengths[k] < 4 * wheel.width_m or not _is_outside(context, at_m, direction, wheel):
            continue
        if len(wheel_centres_m) and np.linalg.norm(wheel_centres_m - at_m, axis=1).min() < 3 * wheel.rim_m:
            continue
        if _is_clear(context.capsules, int(pieces[k]), wheel, at_m, direction):
            return wheel, at_m, direction
    return None


def _is_outside(
    context: PlacementContext, at_m: Float64[ndarray, " 3"], direction: Float64[ndarray, " 3"], wheel: Wheel
) -> bool:
    """Return whether the wheel extends sideways beyond the box of the steel and stays above the ground."""
    is_end = context.is_life_size & (np.abs(direction[:2]) > 0.7)  # Bars of generated cages end at this side.
    to_side_m = np.minimum(at_m - context.low_m, context.high_m - at_m)[:2].min(where=~is_end, initial=np.inf)
    return bool(to_side_m < wheel.rim_m and at_m[2] - np.hypot(wheel.rim_m, wheel.width_m) > GAP_M)


def _is_clear(
    capsules: Capsules, piece: int, wheel: Wheel, at_m: Float64[ndarray, " 3"], direction: Float64[ndarray, " 3"]
) -> bool:
    """Return whether the wheel, from hub to rim, is clear of every capsule except its own ``piece``."""
    angle = np.linspace(0.0, 2 * np.pi, CIRCLE_SAMPLES, endpoint=False)
    radii = np.linspace(wheel.bore_m, wheel.rim_m, 5)
    heights = np.linspace(-wheel.width_m / 2, wheel.width_m / 2, 3)
    r, a, h = (grid.ravel() for grid in np.meshgrid(radii, angle, heights, indexing="ij"))
    local = np.stack([r * np.cos(a), r * np.sin(a), h], axis=1)
    points_m = local @ _frame_along(direction).T + at_m
    # Every point of the wheel is within half a cell diagonal of a sample.
    cell_m = (2 * np.pi * wheel.rim_m / CIRCLE_SAMPLES, radii[1] - radii[0], heights[1] - heights[0])
    return bool(capsules.clearance_m(points_m, without=piece) > np.linalg.norm(cell_m) / 2)


def _wheel_mesh(wheel: Wheel) -> Mesh:
    """Return the wheel around the z axis: hub, rim, and spokes that end inside both."""
    depth_m = wheel.rim_m - wheel.bore_m
    hub_m, tyre_m, half_m = wheel.bore_m + 0.22 * depth_m, wheel.rim_m - 0.2 * depth_m, wheel.width_m / 2
    spoke = box(
        (hub_m - 0.1 * depth_m, -0.08 * depth_m, -0.8 * half_m),
        (tyre_m + 0.1 * depth_m, 0.08 * depth_m, 0.8 * half_m),
    )
    spokes = [transformed(spoke, rotation_about_z(360.0 * k / SPOKES), (0.0, 0.0, 0.0)) for k in range(SPOKES)]
    return merge_meshes([_ring(wheel.bore_m, hub_m, half_m), _ring(tyre_m, wheel.rim_m, half_m), *spokes])


def _ring(inner_m: float, outer_m: float, half_m: float) -> Mesh:
    # The sides of the polygon, not its corners, are at the inner radius, so that the bore does not cut the bar.
    inner_m = inner_m / np.cos(np.pi / CIRCLE_SAMPLES)
    outline = [(inner_m, -half_m), (outer_m, -half_m), (outer_m, half_m), (inner_m, half_m)]
    return lathe(np.array(outline), CIRCLE_SAMPLES)


def _frame_along(direction: Float64[ndarray, " 3"]) -> Float64[ndarray, "3 3"]:
    """Return a rotation matrix that maps the z axis to ``direction``."""
    least_aligned = np.eye(3)[np.argmin(np.abs(direction))]
    x = np.cross(least_aligned, direction)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(direction, x), direction], axis=1)


BLOCK_HALF_M = 0.02
SPACING_M = 0.7
"""Half the width of a block, and the largest distance of the places where blocks are sought, along each side."""
_REACH_M = 0.35
"""Largest distance of a block from its place."""
_LAYER_M = 0.012
"""Height above the lowest steel within ``_REACH_M`` up to which bars are supported."""
_MAT_M = 0.05
"""Height above the lowest steel of a cage up to which its bars are supported anywhere."""
_MAX_SLOPE = 0.1
"""Largest rise per length of a supported part of a bar: a block below a bend would carry nothing."""
_SAMPLE_M = 0.02
_CLEAR_M = 4e-4
"""Distance of the points along bars at which a block is tried, and the least distance of a block from steel."""


def supports(context: PlacementContext) -> tuple[Part, ...]:
    """Return the blocks as one part, or nothing for a cage that stands or lies on the ground."""
    if context.low_m[2] < LEAST_COVER_M:
        return ()
    return blocks("supports", context, context.low_m, context.high_m, 1.5 * GAP_M)


def blocks(
    name: str,
    context: PlacementContext,
    low_m: Float64[ndarray, " 3"],
    high_m: Float64[ndarray, " 3"],
    foot_m: float,
) -> tuple[Part, ...]:
    """Return blocks from the height ``foot_m`` up to the lowest steel of a box, as one part, or nothing."""
    below = _points_below_bars(context.capsules, low_m[2], 0.5 * (foot_m + low_m[2]))
    below = below[((below[:, :2] >= low_m[:2]) & (below[:, :2] <= high_m[:2])).all(axis=1)]
    tops_m: list[Float64[ndarray, " 3"]] = []
    for place_m in _places_m(low_m, high_m):
        distance_m = np.hypot(*(below[:, :2] - place_m).T)
        distance_m[below[:, 2] > below[distance_m < _REACH_M, 2].min(initial=np.inf) + _LAYER_M] = np.inf
        for index in np.argsort(distance_m, kind="stable"):
            top_m = below[index]
            if distance_m[index] > _REACH_M:
                break
            is_apart = all(np.abs(top_m - other)[:2].max() > 3 * BLOCK_HALF_M for other in tops_m)
            if is_apart and _is_block_clear(context.capsules, top_m):
                tops_m.append(top_m)
                break
    meshes = [
        box((x - BLOCK_HALF_M, y - BLOCK_HALF_M, foot_m), (x + BLOCK_HALF_M, y + BLOCK_HALF_M, z))
        for x, y, z in (top_m.tolist() for top_m in tops_m)
    ]
    return (surface(name, merge_meshes(meshes), "concrete"),) if meshes else ()


def _places_m(low_m: Float64[ndarray, " 3"], high_m: Float64[ndarray, " 3"]) -> Float64[ndarray, "n 2"]:
    """Return places for blocks: a grid over a box seen from above, from edge to edge."""
    axes: list[Float64[ndarray, " n"]] = []
    for low, high in zip(low_m[:2], high_m[:2], strict=True):
        inset = min(0.06, 0.25 * (high - low))
        axes.append(np.linspace(low + inset, high - inset, 1 + int(np.ceil((high - low - 2 * inset) / SPACING_M))))
    return np.asarray(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2))


def _points_below_bars(capsules: Capsules, lowest_m: float, above_m: float) -> Float64[ndarray, "n 3"]:
    """Return points below level bars near the lowest steel, at the height of the top of a block there."""
    bottoms_m = np.minimum(capsules.a_m[:, 2], capsules.b_m[:, 2]) - capsules.radius_m
    lowest = capsules.select((bottoms_m > lowest_m - _LAYER_M) & (bottoms_m < lowest_m + _MAT_M))
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
    return np.asarray(joined[joined[:, 2] > above_m])


def _is_block_clear(capsules: Capsules, top_m: Float64[ndarray, " 3"]) -> bool:
    """Return whether the upper part of a block is clear of all bars; none is lower there."""
    at, down = np.linspace(-BLOCK_HALF_M, BLOCK_HALF_M, 9), np.linspace(-1.5 * _LAYER_M, 0.0, 5)
    grid = np.stack(np.meshgrid(at, at, down, indexing="ij"), axis=-1).reshape(-1, 3) + top_m
    return capsules.clearance_m(grid) > _CLEAR_M
