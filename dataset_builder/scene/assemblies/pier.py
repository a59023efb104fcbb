"""Pier assembly: a tall square cage of straight verticals, lapped half hoops and hooked ties.

The cage stands on z = 0, centred on x = y = 0. The verticals stand in four rows, each counted from the
negative side; hoops lie outside of them, ties hook round them. Every level is a stack of three layers, each
one bar thick: the first half hoop, the second half hoop, the tie.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count, pairwise
from math import ceil, gcd, sqrt

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.config.specs import PierSpec
from dataset_builder.scene.assemblies.lattice import LIFT_M
from dataset_builder.scene.model import Assembly, Mesh, axis_of
from dataset_builder.scene.shapes.bar_mesh import plain_bar_mesh, plain_outer_radius_m
from dataset_builder.scene.shapes.bending import bend_radius_m, bent_line_m
from rebar_depth_bench.data.bars import Bar

VERTICAL, HOOP, TIE = "vertical", "hoop", "tie"

HOOK_DEG = 135.0
"""Hook angle at both ends of half hoops and at one end of each tie."""

TIE_SECOND_HOOK_DEG = 90.0
"""Hook angle at the other end of each tie."""

MAX_RING_SPACING_M = 0.2
"""Largest distance between mesh rings along a bar, metres.

Cycles loses precision in float32 with triangles that are as long as a bar and millimetres wide.
"""

CLEAR_GAP_M = 5e-4
"""Clear distance between bars that would be tied together, metres, so that no surfaces coincide."""

HOOK_EXTENSION_DIAMETERS = 10.0
"""Straight end of a hook in diameters: EN 1998-1, 5.6.1 at 135 degrees, EN 1992-1-1, figure 8.5 at 90 degrees."""

MIN_LAP_DIAMETERS = 40.0
"""Least straight overlap of two half hoops in diameters; laps end on verticals and are therefore longer."""


@dataclass(frozen=True)
class BentBarType:
    """A type of bent bar: nominal diameter, outer radius of its mesh and bend radius of its centreline."""

    diameter_m: float
    outer_radius_m: float
    bend_radius_m: float

    @property
    def hook_extension_m(self) -> float:
        """Length of the straight end of a hook, metres."""
        return HOOK_EXTENSION_DIAMETERS * self.diameter_m


@dataclass(frozen=True)
class PierLayout:
    """Positions of all bars of a pier, metres.

    ``rows_m`` are the positions of a side's verticals along it, corners included. Verticals between corners are
    at a distance ``face_m`` from the middle plane; corner verticals are further in, in the bend of the hoops.
    Centrelines of hoops are at ``hoop_line_m`` from the middle plane, the ends of ties reach to ``tie_line_m``.
    ``lap_rows`` are the indices of a side's verticals round which half hoops end with hooks. ``level_layers_m``
    are the heights of first half hoop, second half hoop and tie of each level.
    """

    hoop: BentBarType
    tie: BentBarType
    rows_m: tuple[float, ...]
    face_m: float
    hoop_line_m: float
    tie_line_m: float
    lap_rows: tuple[int, int]
    level_layers_m: tuple[tuple[float, float, float], ...]

    @property
    def intervals(self) -> int:
        """Number of spaces between the verticals of one side."""
        return len(self.rows_m) - 1


@dataclass(frozen=True, eq=False)
class _BarShape:
    """Centreline and mesh of a bent bar in its own frame; bars of the same shape differ by a translation only."""

    role: str
    diameter_m: float
    line_m: Float64[ndarray, "n 3"]
    mesh: Mesh


def pier_assembly(spec: PierSpec) -> Assembly:
    """Return the cage of ``spec``, centred on x = y = 0, from z = 0 (plus ``LIFT_M``) upwards, metres.

    Bars are numbered from 1: first the verticals, counter-clockwise from the corner at -x, -y; then the half
    hoops, level by level from below, on each level first the half whose back is at the positive side (+x or +y);
    then the ties, level by level. On even levels, counted from 0, half hoops lap on the two sides that face y and
    the tie runs along x; on odd levels x and y are exchanged. Laps end in 135 degree hooks round verticals, into
    the core. A tie holds two opposite verticals, with a 135 degree hook at one end and a 90 degree hook at the
    other; the ends alternate from one tie of a direction to the next.
    """
    return Assembly.from_meshes(
        (
            Bar(bar_id, shape.role, shape.diameter_m, axis_of(shape.line_m + shift_m)),
            Mesh(shape.mesh.vertices_m + shift_m, shape.mesh.faces),
        )
        for bar_id, (shape, shift_m) in enumerate(_placed_shapes(spec, pier_layout(spec)), start=1)
    )


def _placed_shapes(spec: PierSpec, layout: PierLayout) -> Iterator[tuple[_BarShape, Float64[ndarray, " 3"]]]:
    """Yield each bar's shape and its translation (world, metres), in the order of the bar ids."""
    upright = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, spec.height_m]])
    vertical = _bar_shape(VERTICAL, spec.vertical_diameter_m, upright)
    for x_m, y_m in vertical_positions_m(layout):
        yield vertical, np.array([x_m, y_m, LIFT_M])
    halves = {
        (along_axis, back): _half_hoop(layout, along_axis, back) for along_axis in (0, 1) for back in (1, -1)
    }
    for level, (first_m, second_m, _) in enumerate(layout.level_layers_m):
        yield halves[level % 2, 1], np.array([0.0, 0.0, first_m + LIFT_M])
        yield halves[level % 2, -1], np.array([0.0, 0.0, second_m + LIFT_M])
    ties = {(along_axis, end): _tie(layout, along_axis, end) for along_axis in (0, 1) for end in (1, -1)}
    for level, (_, _, tie_m) in enumerate(layout.level_layers_m):
        along_axis, turn = level % 2, level // 2
        shift_m = np.array([0.0, 0.0, tie_m + LIFT_M])
        shift_m[1 - along_axis] = layout.rows_m[tie_row(turn, layout.intervals)]
        yield ties[along_axis, 1 - 2 * (turn % 2)], shift_m


def _half_hoop(layout: PierLayout, along_axis: int, back: int) -> _BarShape:
    """Return a U-shaped half hoop at z = 0.

    Its back is at the positive or negative side (``back``: 1 or -1) of the axis ``along_axis`` (0: x, 1: y). Its
    legs run along that axis to the verticals at the far end of the lap, where hooks bend into the core.
    """
    line_m, low_high = layout.hoop_line_m, layout.lap_rows
    leg_end_m = layout.rows_m[low_high[0] if back > 0 else low_high[1]]
    ahead = np.array([-back, 0.0])
    hooks = [
        _hook(np.array([leg_end_m, side * line_m]), ahead, np.array([0.0, -side]), HOOK_DEG, layout.hoop)
        for side in (1.0, -1.0)
    ]
    backbone = np.array([[back * line_m, line_m], [back * line_m, -line_m]])
    corners = np.concatenate([hooks[0][::-1], backbone, hooks[1]])
    return _bent_shape(HOOP, layout.hoop, corners, along_axis)


def _tie(layout: PierLayout, along_axis: int, hooked_end: int) -> _BarShape:
    """Return a tie at z = 0 along ``along_axis`` (0: x, 1: y), its 135 degree hook at ``hooked_end`` (1 or -1).

    The verticals that it holds are at 0 on the other axis, in the centres of its bends.
    """
    radius_m = layout.tie.bend_radius_m
    hooks = [
        _hook(
            np.array([end * (layout.tie_line_m - radius_m), -radius_m]),
            np.array([end, 0.0]),
            np.array([0.0, 1.0]),
            HOOK_DEG if end == hooked_end else TIE_SECOND_HOOK_DEG,
            layout.tie,
        )
        for end in (-1, 1)
    ]
    return _bent_shape(TIE, layout.tie, np.concatenate([hooks[0][::-1], hooks[1]]), along_axis)


def _hook(
    start: Float64[ndarray, " 2"],
    ahead: Float64[ndarray, " 2"],
    inward: Float64[ndarray, " 2"],
    turn_deg: float,
    bar_type: BentBarType,
) -> Float64[ndarray, "2 2"]:
    """Return corner and tip of a hook whose bend begins at ``start`` on a leg in direction ``ahead``, metres."""
    turn = np.deg2rad(turn_deg)
    tangent_m = bar_type.bend_radius_m * np.tan(turn / 2)
    corner = start + tangent_m * ahead
    back = np.cos(turn) * ahead + np.sin(turn) * inward
    return np.stack([corner, corner + (tangent_m + bar_type.hook_extension_m) * back])


def _bent_shape(role: str, bar_type: BentBarType, corners: Float64[ndarray, "n 2"], along_axis: int) -> _BarShape:
    """Return the bar bent along ``corners``, with coordinates (along ``along_axis``, across it), at z = 0."""
    flat = np.roll(corners, along_axis, axis=1)
    line_m = bent_line_m(np.column_stack([flat, np.zeros(len(flat))]), bar_type.bend_radius_m)
    return _bar_shape(role, bar_type.diameter_m, line_m)


def _bar_shape(role: str, diameter_m: float, line_m: Float64[ndarray, "n 3"]) -> _BarShape:
    """Return the shape of a bar, whose mesh has more rings than its centreline has points."""
    return _BarShape(role, diameter_m, line_m, plain_bar_mesh(_with_rings_added(line_m), diameter_m))


def _with_rings_added(line_m: Float64[ndarray, "n 3"]) -> Float64[ndarray, "k 3"]:
    """Return the line with points added so that neighbours are at most ``MAX_RING_SPACING_M`` apart."""
    pieces = [line_m[:1]]
    for start, end in pairwise(line_m):
        count = int(np.ceil(np.linalg.norm(end - start) / MAX_RING_SPACING_M))
        pieces.append(start + (end - start) * np.arange(1, count + 1)[:, None] / count)
    return np.concatenate(pieces)


def pier_layout(spec: PierSpec) -> PierLayout:
    """Return the positions of all bars of ``spec``, which has room for them; its verticals are a multiple of 4."""
    vertical_m = plain_outer_radius_m(spec.vertical_diameter_m)
    hoop = _bent_bar_type(spec.hoop_diameter_m, vertical_m)
    tie = _bent_bar_type(spec.tie_diameter_m, vertical_m)
    hoop_line_m = spec.side_m / 2 - hoop.outer_radius_m
    face_m = hoop_line_m - hoop.outer_radius_m - CLEAR_GAP_M - vertical_m
    corner_m = hoop_line_m - _corner_inset_m(hoop, vertical_m)
    rows_m = np.linspace(-corner_m, corner_m, spec.verticals // 4 + 1)
    spacing_m = float(rows_m[1] - rows_m[0])
    return PierLayout(
        hoop=hoop,
        tie=tie,
        rows_m=tuple(float(row) for row in rows_m),
        face_m=face_m,
        hoop_line_m=hoop_line_m,
        tie_line_m=face_m + vertical_m + CLEAR_GAP_M + tie.outer_radius_m,
        lap_rows=_lap_rows(len(rows_m) - 1, spacing_m, hoop.diameter_m),
        level_layers_m=_level_layers_m(spec, hoop, tie),
    )


def vertical_positions_m(layout: PierLayout) -> Float64[ndarray, "n 2"]:
    """Return the positions (x, y) of the verticals, counter-clockwise from the corner at -x, -y."""
    side = [(row_m, -layout.face_m) for row_m in layout.rows_m[:-1]]
    side[0] = (layout.rows_m[0], layout.rows_m[0])
    south = np.array(side)
    east = np.stack([-south[:, 1], south[:, 0]], axis=1)
    return np.concatenate([south, east, -south, -east])


def tie_row(tie_number: int, intervals: int) -> int:
    """Return the row (never a corner) that the tie ``tie_number`` of its direction holds.

    Consecutive ties are far apart: steps of seven rows, or of the next number that is coprime to the number of
    inner rows, visit all inner rows.
    """
    rows = intervals - 1
    step = next(step for step in count(7) if gcd(step, rows) == 1)
    return 1 + step * tie_number % rows


def _bent_bar_type(diameter_m: float, vertical_m: float) -> BentBarType:
    """Return the bar type with the smallest mandrel of EN 1992-1-1, or a larger one if a vertical requires it."""
    outer_m = plain_outer_radius_m(diameter_m)
    return BentBarType(diameter_m, outer_m, max(bend_radius_m(diameter_m), vertical_m + CLEAR_GAP_M + outer_m))


def _corner_inset_m(hoop: BentBarType, vertical_m: float) -> float:
    """Return the distance of a corner vertical from both legs of a hoop at which the bend clears it, metres."""
    clearance_m = hoop.bend_radius_m - hoop.outer_radius_m - CLEAR_GAP_M - vertical_m
    return hoop.bend_radius_m - clearance_m / sqrt(2)


def _lap_rows(intervals: int, spacing_m: float, diameter_m: float) -> tuple[int, int]:
    """Return the indices of the verticals at which a side's lap begins and ends, centred on the side."""
    spanned_intervals = ceil(MIN_LAP_DIAMETERS * diameter_m / spacing_m)
    low = (intervals - spanned_intervals) // 2
    return low, low + spanned_intervals


def _level_layers_m(spec: PierSpec, hoop: BentBarType, tie: BentBarType) -> tuple[tuple[float, float, float], ...]:
    """Return the heights of first half hoop, second half hoop and tie of each level, evenly spaced."""
    above_first = np.cumsum(
        [0.0, 2 * hoop.outer_radius_m + CLEAR_GAP_M, hoop.outer_radius_m + CLEAR_GAP_M + tie.outer_radius_m]
    )
    stack_m = hoop.outer_radius_m + float(above_first[2]) + tie.outer_radius_m
    pitch_m = spec.height_m / spec.levels
    lowest_m = (pitch_m - stack_m) / 2 + hoop.outer_radius_m
    heights = lowest_m + pitch_m * np.arange(spec.levels)[:, None] + above_first
    return tuple((float(first), float(second), float(tied)) for first, second, tied in heights)
