"""Pier assembly: a tall square cage of straight verticals, lapped half hoops and hooked ties. World frame, metres.

The cage stands on z = 0, centred on x = y = 0. The verticals stand in four rows, each counted from the negative
side; hoops lie outside of them, ties hook round them. Every level is a stack of three layers, each one bar thick:
the first half hoop, the second half hoop, the tie.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count, pairwise
from math import ceil, gcd, sqrt

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.cages.design import STANDING_M
from dataset_builder.scene.model import Assembly, Mesh, axis_of
from dataset_builder.scene.shapes.bar_mesh import plain_bar_mesh, plain_outer_radius_m
from dataset_builder.scene.shapes.bending import bend_radius_m, bent_line_m
from dataset_builder.scene.shapes.links import HOOK_DEG, SQUARE_HOOK_DEG, hook_m, tie_centreline_m
from dataset_builder.specs.config_specs import PierSpec
from rebar_depth_bench.data.bars import Bar

VERTICAL, HOOP, TIE = "vertical", "hoop", "tie"

CLEAR_GAP_M = 5e-4
"""Clear distance between bars that would be tied together, metres, so that no surfaces coincide."""

HOOK_EXTENSION_DIAMETERS = 10.0
"""Straight end of a hook in diameters: EN 1998-1, 5.6.1 at 135 degrees, EN 1992-1-1, figure 8.5 at 90 degrees."""

MIN_LAP_DIAMETERS = 40.0
"""Least straight overlap of two half hoops in diameters; laps end on verticals and are therefore longer."""

MAX_RING_SPACING_M = 0.2
"""Largest distance between mesh rings along a bar, metres.

Cycles loses precision in float32 with triangles that are as long as a bar and millimetres wide.
"""

_BEND_STEP_DEG = 6.0
"""Largest angle between sampled points of a bend."""


@dataclass(frozen=True)
class _BentBarType:
    """A type of bent bar: nominal diameter, outer radius of its mesh and bend radius of its centreline."""

    diameter_m: float
    outer_radius_m: float
    bend_radius_m: float

    @property
    def hook_extension_m(self) -> float:
        """Length of the straight end of a hook, metres."""
        return HOOK_EXTENSION_DIAMETERS * self.diameter_m


@dataclass(frozen=True, eq=False)
class _Layout:
    """Positions of all bars of a pier, metres.

    ``rows_m`` are the positions of a side's verticals along it, corners included. Verticals between corners are
    at a distance ``face_m`` from the middle plane; corner verticals are further in, in the bend of the hoops.
    Centrelines of hoops are at ``hoop_line_m`` from the middle plane, the ends of ties reach to ``tie_line_m``.
    ``lap_rows`` are the indices of a side's verticals round which half hoops end with hooks. ``level_layers_m``
    are the heights of first half hoop, second half hoop and tie of each level.
    """

    hoop: _BentBarType
    tie: _BentBarType
    rows_m: Float64[ndarray, " r"]
    face_m: float
    hoop_line_m: float
    tie_line_m: float
    lap_rows: tuple[int, int]
    level_layers_m: Float64[ndarray, "n 3"]


@dataclass(frozen=True, eq=False)
class _BarShape:
    """Centreline and mesh of a bar in its own frame; bars of the same shape differ by a translation only."""

    role: str
    diameter_m: float
    line_m: Float64[ndarray, "n 3"]
    mesh: Mesh


def pier_assembly(spec: PierSpec) -> Assembly:
    """Return the cage of ``spec``, centred on x = y = 0, from z = 0 (plus ``STANDING_M``) upwards, metres.

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
        for bar_id, (shape, shift_m) in enumerate(_placed_shapes(spec, _layout(spec)), start=1)
    )


def _layout(spec: PierSpec) -> _Layout:
    """Return the positions of all bars of ``spec``, which has room for them; its verticals are a multiple of 4."""
    vertical_m = plain_outer_radius_m(spec.vertical_diameter_m)
    hoop = _bent_bar_type(spec.hoop_diameter_m, vertical_m)
    tie = _bent_bar_type(spec.tie_diameter_m, vertical_m)
    hoop_line_m = spec.side_m / 2 - hoop.outer_radius_m
    face_m = hoop_line_m - hoop.outer_radius_m - CLEAR_GAP_M - vertical_m
    # A corner vertical is as far from both legs of a hoop as its bend, of which it is clear, requires.
    clearance_m = hoop.bend_radius_m - hoop.outer_radius_m - CLEAR_GAP_M - vertical_m
    corner_m = hoop_line_m - (hoop.bend_radius_m - clearance_m / sqrt(2))
    rows_m = np.linspace(-corner_m, corner_m, spec.verticals // 4 + 1)
    # The lap is centred on its side and ends at verticals.
    lap_intervals = ceil(MIN_LAP_DIAMETERS * hoop.diameter_m / float(rows_m[1] - rows_m[0]))
    first_lap_row = (len(rows_m) - 1 - lap_intervals) // 2
    return _Layout(
        hoop=hoop,
        tie=tie,
        rows_m=rows_m,
        face_m=face_m,
        hoop_line_m=hoop_line_m,
        tie_line_m=face_m + vertical_m + CLEAR_GAP_M + tie.outer_radius_m,
        lap_rows=(first_lap_row, first_lap_row + lap_intervals),
        level_layers_m=_level_layers_m(spec, hoop, tie),
    )


def _bent_bar_type(diameter_m: float, vertical_m: float) -> _BentBarType:
    """Return the bar type with the smallest mandrel of EN 1992-1-1, or a larger one if a vertical requires it."""
    outer_m = plain_outer_radius_m(diameter_m)
    return _BentBarType(diameter_m, outer_m, max(bend_radius_m(diameter_m), vertical_m + CLEAR_GAP_M + outer_m))


def _level_layers_m(spec: PierSpec, hoop: _BentBarType, tie: _BentBarType) -> Float64[ndarray, "n 3"]:
    """Return the heights of first half hoop, second half hoop and tie of each level, evenly spaced."""
    above_first = np.cumsum(
        [0.0, 2 * hoop.outer_radius_m + CLEAR_GAP_M, hoop.outer_radius_m + CLEAR_GAP_M + tie.outer_radius_m]
    )
    stack_m = hoop.outer_radius_m + float(above_first[2]) + tie.outer_radius_m
    pitch_m = spec.height_m / spec.levels
    lowest_m = (pitch_m - stack_m) / 2 + hoop.outer_radius_m
    return np.asarray(lowest_m + pitch_m * np.arange(spec.levels)[:, None] + above_first)


def _placed_shapes(spec: PierSpec, layout: _Layout) -> Iterator[tuple[_BarShape, Float64[ndarray, " 3"]]]:
    """Yield each bar's shape and its translation (world, metres), in the order of the bar ids."""
    upright = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, spec.height_m]])
    vertical = _bar_shape(VERTICAL, spec.vertical_diameter_m, upright)
    for x_m, y_m in _vertical_positions_m(layout):
        yield vertical, np.array([x_m, y_m, STANDING_M])
    halves = {
        (along_axis, back): _half_hoop(layout, along_axis, back) for along_axis in (0, 1) for back in (1, -1)
    }
    for level, (first_m, second_m, _) in enumerate(layout.level_layers_m):
        yield halves[level % 2, 1], np.array([0.0, 0.0, first_m + STANDING_M])
        yield halves[level % 2, -1], np.array([0.0, 0.0, second_m + STANDING_M])
    ties = {(along_axis, end): _tie(layout, along_axis, end) for along_axis in (0, 1) for end in (1, -1)}
    for level, (_, _, tie_m) in enumerate(layout.level_layers_m):
        along_axis, turn = level % 2, level // 2
        shift_m = np.array([0.0, 0.0, tie_m + STANDING_M])
        shift_m[1 - along_axis] = layout.rows_m[_tie_row(turn, len(layout.rows_m) - 2)]
        yield ties[along_axis, 1 - 2 * (turn % 2)], shift_m


def _vertical_positions_m(layout: _Layout) -> Float64[ndarray, "n 2"]:
    """Return the positions (x, y) of the verticals, counter-clockwise from the corner at -x, -y."""
    south = np.column_stack([layout.rows_m[:-1], np.full(len(layout.rows_m) - 1, -layout.face_m)])
    south[0] = layout.rows_m[0]
    east = np.stack([-south[:, 1], south[:, 0]], axis=1)
    return np.concatenate([south, east, -south, -east])


def _tie_row(tie_number: int, inner_rows: int) -> int:
    """Return the row (never a corner) that the tie ``tie_number`` of its direction holds.

    Consecutive ties are far apart: steps of seven rows, or of the next number that is coprime to the number of
    inner rows, visit all inner rows.
    """
    step = next(step for step in count(7) if gcd(step, inner_rows) == 1)
    return 1 + step * tie_number % inner_rows


def _half_hoop(layout: _Layout, along_axis: int, back: int) -> _BarShape:
    """Return a U-shaped half hoop at z = 0.

    Its back is at the positive or negative side (``back``: 1 or -1) of the axis ``along_axis`` (0: x, 1: y). Its
    legs run along that axis to the verticals at the far end of the lap, where hooks bend into the core.
    """
    line_m, radius_m, extension_m = layout.hoop_line_m, layout.hoop.bend_radius_m, layout.hoop.hook_extension_m
    leg_end_m = float(layout.rows_m[layout.lap_rows[0 if back > 0 else 1]])
    first, last = (
        hook_m((leg_end_m, side * line_m), (-back, 0.0), (0.0, -side), HOOK_DEG, radius_m, extension_m)
        for side in (1.0, -1.0)
    )
    backbone = np.array([[back * line_m, line_m], [back * line_m, -line_m]])
    corners = np.roll(np.concatenate([first[::-1], backbone, last]), along_axis, axis=1)
    flat_m = np.column_stack([corners, np.zeros(len(corners))])
    return _bar_shape(HOOP, layout.hoop.diameter_m, bent_line_m(flat_m, radius_m, _BEND_STEP_DEG))


def _tie(layout: _Layout, along_axis: int, hooked_end: int) -> _BarShape:
    """Return a tie at z = 0 along ``along_axis`` (0: x, 1: y), its 135 degree hook at ``hooked_end`` (1 or -1).

    The verticals that it holds are at 0 on the other axis, in the centres of its bends.
    """
    radius_m, extension_m = layout.tie.bend_radius_m, layout.tie.hook_extension_m
    half_m = layout.tie_line_m - radius_m
    first_deg, second_deg = (SQUARE_HOOK_DEG, HOOK_DEG) if hooked_end > 0 else (HOOK_DEG, SQUARE_HOOK_DEG)
    line_m = tie_centreline_m(half_m, radius_m, extension_m, second_deg, first_deg, _BEND_STEP_DEG)
    line_m[:, :2] = np.roll(line_m[:, :2], along_axis, axis=1)
    return _bar_shape(TIE, layout.tie.diameter_m, line_m)


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
