"""Groups of the views of a config with splits: by cage family, by distance and by bar width in pixels.

The group of a view depends on the ground truth alone, so that all submissions have the same groups.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float32, Float64, UInt16
from numpy import ndarray

from rebar_depth_bench.scoring.metrics import median

DISTANCE_EDGES_M = (0.0, 0.5, 1.0, 2.0, 4.0, math.inf)
"""Edges of the bins of distance, metres; a bin includes its lower edge."""

WIDTH_EDGES_PX = (0.0, 2.0, 4.0, 8.0, 16.0, math.inf)
"""Edges of the bins of bar width, pixels; a bin includes its lower edge."""


@dataclass(frozen=True)
class ViewTraits:
    """Properties of a view, from its ground truth, by which views are grouped.

    ``family`` is that of the scene, None if it has none. ``distance_m`` is the median true depth of the scored
    pixels. ``bar_width_px`` is the median of f d / z over these, None if the diameter of no bar is known.
    """

    family: str | None
    distance_m: float
    bar_width_px: float | None


@dataclass(frozen=True)
class Grouping:
    """Partition of views into groups.

    ``definition`` completes "The group of a view is ...". ``group_of`` returns the group of a view, None if it
    belongs to none. ``order`` has the groups in order; groups that are not in it follow by name.
    """

    title: str
    definition: str
    group_of: Callable[[ViewTraits], str | None]
    order: tuple[str, ...] = ()


def _bins(
    title: str, definition: str, value_of: Callable[[ViewTraits], float | None], edges: Sequence[float], unit: str
) -> Grouping:
    """Return the grouping by the bin of a value, such as ``0.5-1 m`` or, for the last one, ``4+ m``.

    Views without a value belong to no group.
    """
    names = tuple(f"{low:g}{f'-{high:g}' if math.isfinite(high) else '+'} {unit}" for low, high in pairwise(edges))

    def group_of(view: ViewTraits) -> str | None:
        value = value_of(view)
        return None if value is None else names[int(np.searchsorted(edges[1:-1], value, side="right"))]

    return Grouping(title, definition, group_of, names)


GROUPINGS: Mapping[str, Grouping] = {
    "family": Grouping("cage family", "the family of its cage", lambda view: view.family),
    "distance": _bins(
        "distance",
        "the bin of the median true depth of its scored pixels",
        lambda view: view.distance_m,
        DISTANCE_EDGES_M,
        "m",
    ),
    "bar_width": _bins(
        "bar width",
        "the bin of the median of f d / z over its scored pixels: focal length in pixels times the bar's nominal "
        "diameter by true depth",
        lambda view: view.bar_width_px,
        WIDTH_EDGES_PX,
        "px",
    ),
}
"""Groupings by their key in the result's JSON, in the order of tables."""


def positions_by_group(grouping: Grouping, views: Sequence[ViewTraits]) -> dict[str, list[int]]:
    """Return the positions of the views of each group that has any, by group in the order of the grouping."""
    positions: dict[str, list[int]] = {}
    for position, view in enumerate(views):
        group = grouping.group_of(view)
        if group is not None:
            positions.setdefault(group, []).append(position)
    rank = {group: number for number, group in enumerate(grouping.order)}
    order = sorted(positions, key=lambda group: (rank.get(group, len(rank)), group))
    return {group: positions[group] for group in order}


def bar_width_px(
    depth_m: Float32[ndarray, " n"],
    bar_id: UInt16[ndarray, " n"],
    diameter_m: Mapping[int, float],
    focal_px: float,
) -> float | None:
    """Return the median of f d / z over the pixels of a view whose bar has a known diameter; None without any.

    ``depth_m`` is planar depth > 0 and ``bar_id`` the bar of each pixel; ``diameter_m`` has the nominal diameter
    of each bar where it is known.
    """
    ids, position = np.unique(bar_id, return_inverse=True)
    known_m: Float64[ndarray, " ids"] = np.array([diameter_m.get(int(bar), math.nan) for bar in ids])
    width_px = focal_px * known_m[position] / depth_m.astype(np.float64)
    measured = width_px[~np.isnan(width_px)]
    return median(measured) if len(measured) else None
