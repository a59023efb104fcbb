"""Summary of a cage: groups of bars, the box of its steel, and bars that touch or penetrate each other."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.assemblies.cage import Cage, CageBar
from dataset_builder.scene.variants.formwork import SHEET_M, world_from_form
from dataset_builder.specs.config_specs import FormSpec
from rebar_depth_bench.bar_crossings.axis_segments import AxisSegments, TooManyNeighboursError
from rebar_depth_bench.base.errors import DatasetError
from rebar_depth_bench.data.bars import Bar, with_axis
from rebar_depth_bench.extended.axes import cage_truth
from rebar_depth_bench.geometry.segments import closest_points_m

STEEL_KG_PER_M3 = 7850.0
"""Density of reinforcing steel (EN 1992-1-1, 3.2.7)."""

CONTACT, CONTACT_M = 0.1, 0.0005
"""Largest gap, and largest overlap, of bars in contact: of their mean diameter, what ribs add, and in metres."""

MAX_PAIRS = 20_000_000
"""Largest number of pairs of neighbouring pieces of axes that are compared."""

_CHUNK = 500_000

Box = Float64[ndarray, "2 3"]
"""Lower and upper corner."""


@dataclass(frozen=True)
class BarGroup:
    """Bars of one diameter (None: unknown), role, host and storey: their number, total length and mass.

    Length and mass are None if the diameter is unknown. ``spacing_m`` has the median, least and greatest distance
    of the axes of neighbouring parallel bars of the group (``extended.axes.overlapping_pairs``), None if there are
    no such pairs, or too many straight segments. ``above_ground_m`` is the least height of a surface above z = 0.
    """

    diameter_mm: float | None
    role: str
    host: str | None
    storey: str | None
    bars: int
    length_m: float | None
    mass_kg: float | None
    spacing_m: tuple[float, float, float] | None
    above_ground_m: float


@dataclass(frozen=True)
class Meeting:
    """Two bars in contact or clashing: largest overlap ``depth_m``, negative for a gap, and its place (world)."""

    bar_a: int
    bar_b: int
    depth_m: float
    point_m: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Inspection:
    """Cage of the file ``name``, its groups, the box of its steel (world, metres), and its ``meetings``.

    ``contacts`` and ``clashes`` are None if too many bars are close to each other to compare them.
    """

    name: str
    cage: Cage
    groups: tuple[BarGroup, ...]
    box_m: Box
    contacts: Sequence[Meeting] | None
    clashes: Sequence[Meeting] | None

    @property
    def size_text(self) -> str:
        """Sides of the box, such as ``1.000 x 0.300 x 0.200 m``."""
        return f"{' x '.join(f'{side:.3f}' for side in self.box_m[1] - self.box_m[0])} m"


def inspect_cage(cage: Cage, name: str) -> Inspection:
    """Return the summary of a cage of one or more bars."""
    boxes_m = np.array([bar_box_m(bar) for bar in cage.bars])
    box_m = np.array([boxes_m[:, 0].min(axis=0), boxes_m[:, 1].max(axis=0)])
    found: tuple[Sequence[Meeting] | None, Sequence[Meeting] | None] = None, None
    with suppress(TooManyNeighboursError):
        found = meetings([bar.bar for bar in cage.bars])
    return Inspection(name, cage, tuple(_groups(cage.bars, boxes_m[:, 0, 2])), box_m, *found)


def form_distance_m(form: FormSpec, bars: Sequence[Bar]) -> float:
    """Return the least distance of bars over the face of a form from it, metres, without ribs; inf without bars.

    It is negative where a bar goes through. Bars behind the sheet, and bars without axis, are left out.
    """
    axes, half_m = AxisSegments.of_bars(with_axis(bars)), np.divide(form.size_m, 2)
    rotation = world_from_form(form)
    start_m, step_m = (axes.start_m - form.point_m) @ rotation, axes.vector_m @ rotation
    slope = step_m[:, 2] / np.maximum(np.linalg.norm(step_m, axis=1), 1e-12)
    reach_m = axes.diameter_m[axes.bar] / 2 * np.sqrt(np.clip(1 - slope**2, 0, 1))
    step_xy_m = np.where(step_m[:, :2] == 0, 1e-200, step_m[:, :2])
    enter, leave = np.sort([(side_m - start_m[:, :2]) / step_xy_m for side_m in (-half_m, half_m)], axis=0)
    first, last = np.maximum(enter.max(axis=1), 0), np.minimum(leave.min(axis=1), 1)
    low_m, high_m = np.sort(start_m[:, 2] + np.array([first, last]) * step_m[:, 2], axis=0)
    is_over = (first <= last) & (high_m + reach_m > -SHEET_M)
    return float((low_m - reach_m)[is_over].min(initial=np.inf))


def meetings(bars: Sequence[Bar]) -> tuple[list[Meeting], list[Meeting]]:
    """Return the pairs of bars in contact, as tied bars are, and those that clash, the deepest first.

    Bars clash if they overlap by more than bars in contact (``CONTACT``). Those without axis are left out. Raises
    ``TooManyNeighboursError`` for more than ``MAX_PAIRS`` neighbours.
    """
    measured = with_axis(bars)
    axes = AxisSegments.of_bars(measured)
    pairs = axes.near_pairs(_contact_m(axes.diameter_m.max(initial=0.0)), MAX_PAIRS)
    pairs = pairs[axes.bar[pairs[:, 0]] != axes.bar[pairs[:, 1]]]
    ends_m = axes.start_m + axes.vector_m
    deepest: dict[tuple[int, int], tuple[float, list[float]]] = {}
    for first in range(0, len(pairs), _CHUNK):
        i, j = pairs[first : first + _CHUNK].T
        on_a, on_b = closest_points_m(axes.start_m[i], ends_m[i], axes.start_m[j], ends_m[j])
        radii_m = (axes.diameter_m[axes.bar[i]] + axes.diameter_m[axes.bar[j]]) / 2
        depth_m = radii_m - np.linalg.norm(on_a - on_b, axis=1)
        for index in np.flatnonzero(depth_m >= -_contact_m(radii_m)).tolist():
            a, b = int(axes.bar[i[index]]), int(axes.bar[j[index]])
            found_m = float(depth_m[index])
            if found_m > deepest.get((a, b), (-np.inf, []))[0]:
                deepest[a, b] = found_m, ((on_a[index] + on_b[index]) / 2).tolist()
    contacts, clashes = list[Meeting](), list[Meeting]()
    for (a, b), (depth_m, (x, y, z)) in sorted(deepest.items(), key=lambda item: (-item[1][0], item[0])):
        is_clash = depth_m > _contact_m((measured[a].diameter_m + measured[b].diameter_m) / 2)
        pair = Meeting(measured[a].bar_id, measured[b].bar_id, depth_m, (x, y, z))
        (clashes if is_clash else contacts).append(pair)
    return contacts, clashes


def _contact_m(mean_diameter_m: Any) -> Any:
    """Return the largest gap and overlap of bars in contact by their mean diameters, of the same shape."""
    return CONTACT * mean_diameter_m + CONTACT_M


def bar_box_m(bar: CageBar) -> Box:
    """Return the box of a bar's surface: of its mesh, or of a circle swept along its axis, without ribs.

    A circle of radius r perpendicular to the unit vector t extends r * sqrt(1 - t_i^2) along the axis i.
    """
    if bar.mesh is not None:
        points_m = bar.mesh.vertices_m
        return np.array([points_m.min(axis=0), points_m.max(axis=0)])
    points_m = bar.points_m
    steps_m = np.diff(points_m, axis=0)
    lengths_m = np.linalg.norm(steps_m, axis=1, keepdims=True)
    tangents = np.divide(steps_m, lengths_m, out=np.zeros_like(steps_m), where=lengths_m > 0)
    reach_m = bar.bar.diameter_m / 2 * np.sqrt(np.clip(1 - tangents**2, 0, 1))
    lower_m = np.minimum(points_m[:-1], points_m[1:]) - reach_m
    upper_m = np.maximum(points_m[:-1], points_m[1:]) + reach_m
    return np.array([lower_m.min(axis=0), upper_m.max(axis=0)])


def diameter_mm(bar: CageBar) -> float | None:
    """Return the diameter of a bar as it is listed, millimetres; None if it is unknown."""
    return round(bar.bar.diameter_m * 1000, 2) if bar.bar.has_axis else None


def _groups(bars: Sequence[CageBar], lowest_m: Float64[ndarray, " n"]) -> list[BarGroup]:
    """Return the groups by descending diameter, then by role, host and storey; unknown diameters last.

    ``lowest_m`` has the least z of each bar's surface.
    """
    by_key: dict[tuple[float | None, str, str | None, str | None], list[int]] = defaultdict(list)
    for position, bar in enumerate(bars):
        by_key[diameter_mm(bar), bar.bar.role, bar.host, bar.storey].append(position)
    ordered = sorted(by_key, key=lambda key: (-(key[0] or 0.0), key[1], key[2] or "", key[3] or ""))
    groups = []
    for key in ordered:
        members, size_mm = [bars[position].bar for position in by_key[key]], key[0]
        length_m = mass_kg = spacing_m = None
        if size_mm is not None:
            length_m = math.fsum(bar.length_m for bar in members)
            mass_kg = math.pi / 4 * (size_mm / 1000) ** 2 * length_m * STEEL_KG_PER_M3
            with suppress(DatasetError):
                apart_m = cage_truth(members).spacing_m
                if len(apart_m):
                    spacing_m = float(np.median(apart_m)), float(apart_m.min()), float(apart_m.max())
        above_ground_m = float(lowest_m[by_key[key]].min())
        groups.append(BarGroup(*key, len(members), length_m, mass_kg, spacing_m, above_ground_m))
    return groups
