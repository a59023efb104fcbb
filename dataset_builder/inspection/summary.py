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


@dataclass(frozen=True)
class FormCover:
    """Form, the ids of the bars that go through its face, and the least cover, metres, with the id of its bar.

    The cover is the least distance from the face of the bars that are in front of it; None without such bars.
    """

    form: FormSpec
    through: tuple[int, ...]
    cover_m: float | None
    bar_id: int | None


@dataclass(frozen=True, eq=False)
class Inspection:
    """Cage of the file ``name``, its groups, the box of its steel (world, metres), its ``meetings`` and forms.

    ``contacts`` and ``clashes`` are None if too many bars are close to each other to compare them.
    """

    name: str
    cage: Cage
    groups: tuple[BarGroup, ...]
    box_m: Box
    contacts: Sequence[Meeting] | None
    clashes: Sequence[Meeting] | None
    forms: tuple[FormCover, ...] = ()

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
    forms = tuple(form_cover(form, cage.bars) for form in cage.forms)
    return Inspection(name, cage, tuple(_groups(cage.bars, boxes_m[:, 0, 2])), box_m, *found, forms)


def form_cover(form: FormSpec, bars: Sequence[CageBar]) -> FormCover:
    """Return the cover of a form by the surfaces of bars, without ribs; bars behind the sheet are ignored.

    Only what is over the face counts, of pieces of axes, or of the edges of meshes where the axis is unknown.
    """
    half_m, through, covers = np.divide(form.size_m, 2), list[int](), list[tuple[float, int]]()
    for bar in bars:
        if bar.mesh is None or bar.bar.has_axis:
            axis_m = np.array(bar.bar.axis_m)
            start_m, end_m, radius_m = axis_m[:-1], axis_m[1:], bar.bar.diameter_m / 2
        else:
            faces = bar.mesh.faces
            start_m, end_m = (
                bar.mesh.vertices_m[corners.ravel()] for corners in (faces, np.roll(faces, 1, axis=1))
            )
            radius_m = 0.0
        start_m, end_m = ((points_m - form.point_m) @ world_from_form(form) for points_m in (start_m, end_m))
        step_m = end_m - start_m
        slope = step_m[:, 2] / np.maximum(np.linalg.norm(step_m, axis=1), 1e-12)
        reach_m = radius_m * np.sqrt(np.clip(1 - slope**2, 0, 1))  # Of a circle across the axis, along the normal.
        step_xy_m = np.where(step_m[:, :2] == 0, 1e-200, step_m[:, :2])
        enter, leave = np.sort([(side_m - start_m[:, :2]) / step_xy_m for side_m in (-half_m, half_m)], axis=0)
        first, last = np.maximum(enter.max(axis=1), 0), np.minimum(leave.min(axis=1), 1)
        over = first <= last
        heights_m = start_m[over, 2] + np.array([first[over], last[over]]) * step_m[over, 2]
        low_m = float((heights_m - reach_m[over]).min(initial=np.inf))
        high_m = float((heights_m + reach_m[over]).max(initial=-np.inf))
        if low_m < 0 and high_m > -SHEET_M:
            through.append(bar.bar.bar_id)
        elif 0 <= low_m < np.inf:
            covers.append((low_m, bar.bar.bar_id))
    return FormCover(form, tuple(through), *min(covers, default=(None, None)))


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
