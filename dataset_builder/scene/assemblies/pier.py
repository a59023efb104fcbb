"""The pier: a square cage of straight verticals, lapped half hoops and hooked ties, as tall as a house."""

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
    Link,
    PierLayout,
    check_stock_length,
    pier_layout,
    tie_row,
    vertical_places_m,
)
from dataset_builder.scene.model import STEEL, Assembly, Bar, Mesh, Part
from dataset_builder.scene.shapes.bar_mesh import plain_bar_mesh
from dataset_builder.scene.shapes.bending import bent_line_m

VERTICAL, HOOP, TIE = "vertical", "hoop", "tie"

HOOK_DEG = 135.0
"""Half hoops end in such hooks round a vertical, and so does one end of each tie."""

OTHER_TIE_END_DEG = 90.0

RING_STEP_M = 0.2
"""Triangles as long as a bar and millimetres wide cost Cycles its precision in float32."""


@dataclass(frozen=True, eq=False)
class _Shape:
    """A bar as bent, in its own frame: centreline and mesh. Bars of one shape differ by a shift alone."""

    role: str
    diameter_m: float
    line_m: Float64[ndarray, "n 3"]
    mesh: Mesh


def pier_assembly(spec: PierSpec) -> Assembly:
    """Return the cage of ``spec``, centred on x = y = 0, from z = 0 (plus ``LIFT_M``) upwards, metres.

    Bars are numbered from 1: first the verticals, counter-clockwise from the corner at -x, -y; then the hoops,
    level by level from below, of each the half whose back is at the positive side (+x or +y) first; then the
    ties, level by level. On even levels, counted from 0, half hoops lap on the two sides that face y and the tie
    runs along x; on odd levels x and y change places. Laps end in 135 degree hooks round verticals, into the
    core. A tie holds two verticals that face each other, a 135 degree hook at one end, 90 degrees at the other;
    the ends change places from one tie of a direction to the next.

    Raises ``ValueError`` where bars of ``spec`` would touch, not fit or be longer than stock bars.
    """
    layout = pier_layout(spec)
    bars, parts = [], []
    for bar_id, (shape, shift_m) in enumerate(_placed_shapes(spec, layout), start=1):
        axis_m = tuple((float(x), float(y), float(z)) for x, y, z in shape.line_m + shift_m)
        bars.append(Bar(bar_id, shape.role, shape.diameter_m, axis_m))
        mesh = Mesh(shape.mesh.vertices_m + shift_m, shape.mesh.faces)
        parts.append(Part(f"{shape.role}-{bar_id:03d}", mesh, bar_id, STEEL))
    return Assembly(tuple(bars), tuple(parts))


def _placed_shapes(spec: PierSpec, layout: PierLayout) -> Iterator[tuple[_Shape, Float64[ndarray, " 3"]]]:
    """Yield each bar's shape and where it is put, in the order of the bar ids."""
    upright = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, spec.height_m]])
    vertical = _shape(VERTICAL, spec.vertical_diameter_m, upright)
    for x_m, y_m in vertical_places_m(layout):
        yield vertical, np.array([x_m, y_m, LIFT_M])
    halves = {(run, back): _half_hoop(layout, run, back) for run in (0, 1) for back in (1, -1)}
    for level, (first_m, second_m, _) in enumerate(layout.level_layers_m):
        yield halves[level % 2, 1], np.array([0.0, 0.0, first_m + LIFT_M])
        yield halves[level % 2, -1], np.array([0.0, 0.0, second_m + LIFT_M])
    ties = {(run, end): _tie(layout, run, end) for run in (0, 1) for end in (1, -1)}
    for level, (_, _, tie_m) in enumerate(layout.level_layers_m):
        run, turn = level % 2, level // 2
        shift_m = np.array([0.0, 0.0, tie_m + LIFT_M])
        shift_m[1 - run] = layout.rows_m[tie_row(turn, layout.intervals)]
        yield ties[run, 1 - 2 * (turn % 2)], shift_m


def _half_hoop(layout: PierLayout, run: int, back: int) -> _Shape:
    """Return a U with its back at the ``back`` (1 or -1) end of the axis ``run`` (0 x, 1 y), at z = 0.

    Its legs run along that axis to the verticals at the far end of the lap, where hooks turn into the core.
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
    return _bent(HOOP, layout.hoop, corners, run)


def _tie(layout: PierLayout, run: int, hooked_end: int) -> _Shape:
    """Return a tie along the axis ``run`` (0 x, 1 y) at z = 0, its 135 degree hook at ``hooked_end`` (1 or -1).

    The verticals that it holds stand at 0 on the other axis, in the middle of its bends.
    """
    radius_m = layout.tie.bend_radius_m
    hooks = [
        _hook(
            np.array([end * (layout.tie_line_m - radius_m), -radius_m]),
            np.array([end, 0.0]),
            np.array([0.0, 1.0]),
            HOOK_DEG if end == hooked_end else OTHER_TIE_END_DEG,
            layout.tie,
        )
        for end in (-1, 1)
    ]
    return _bent(TIE, layout.tie, np.concatenate([hooks[0][::-1], hooks[1]]), run)


def _hook(
    start: Float64[ndarray, " 2"],
    ahead: Float64[ndarray, " 2"],
    inward: Float64[ndarray, " 2"],
    turn_deg: float,
    link: Link,
) -> Float64[ndarray, "2 2"]:
    """Return corner and tip of a hook whose bend begins at ``start``, on a leg that runs ``ahead``, metres."""
    turn = np.deg2rad(turn_deg)
    tangent_m = link.bend_radius_m * np.tan(turn / 2)
    corner = start + tangent_m * ahead
    back = np.cos(turn) * ahead + np.sin(turn) * inward
    return np.stack([corner, corner + (tangent_m + link.hook_extension_m) * back])


def _bent(role: str, link: Link, corners: Float64[ndarray, "n 2"], run: int) -> _Shape:
    """Return the bar bent through ``corners``, given as (along the axis ``run``, across it), at z = 0."""
    flat = np.roll(corners, run, axis=1)
    line_m = bent_line_m(np.column_stack([flat, np.zeros(len(flat))]), link.bend_radius_m)
    return _shape(role, link.diameter_m, line_m)


def _shape(role: str, diameter_m: float, line_m: Float64[ndarray, "n 3"]) -> _Shape:
    check_stock_length(role, float(np.linalg.norm(np.diff(line_m, axis=0), axis=1).sum()))
    return _Shape(role, diameter_m, line_m, plain_bar_mesh(_with_rings(line_m), diameter_m))


def _with_rings(line_m: Float64[ndarray, "n 3"]) -> Float64[ndarray, "k 3"]:
    """Return the line with points in between, none further than ``RING_STEP_M`` from the next."""
    pieces = [line_m[:1]]
    for start, end in pairwise(line_m):
        count = int(np.ceil(np.linalg.norm(end - start) / RING_STEP_M))
        pieces.append(start + (end - start) * np.arange(1, count + 1)[:, None] / count)
    return np.concatenate(pieces)
