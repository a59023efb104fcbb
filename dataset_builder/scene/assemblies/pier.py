"""Pier assembly: a tall square cage of straight verticals, lapped half hoops and hooked ties."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.config.specs import PierSpec
from dataset_builder.scene.assemblies.lattice import LIFT_M
from dataset_builder.scene.assemblies.pier_layout import (
    BentBarType,
    PierLayout,
    pier_layout,
    tie_row,
    vertical_positions_m,
)
from dataset_builder.scene.model import Assembly, Mesh, axis_of
from dataset_builder.scene.shapes.bar_mesh import plain_bar_mesh
from dataset_builder.scene.shapes.bending import bent_line_m
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
