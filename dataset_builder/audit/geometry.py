"""Ground truth against geometry known without the ray caster: the axes of the bars, the plane of the board."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, UInt16
from numpy import ndarray

from dataset_builder.audit.report import Check
from dataset_builder.audit.views import AuditedConfig, AuditedEye, AuditedView
from dataset_builder.scene.model import Bar
from rebar_depth_bench.geometry.aruco_board import BoardSpec

MAX_AXIS_RATIO = 1.2
"""Ribs stand out of the nominal radius by at most this factor."""
MAX_BOARD_ERROR_M = 1e-6
_ARC_CORNER_DEG = 15.0
"""Corners that turn less are those between a bend's chords; sharper ones are corners."""
_CHUNK = 4096
_BOARD_EDGE_M = 0.001
_OCCLUDED_BOARD_M = 1e-4
_MAX_OCCLUDED_SHARE = 0.5


@dataclass(frozen=True)
class BoardError:
    """Of the pixels that look at the board's rectangle and at no steel: how many, and how far from z = 0.

    ``off_m`` is the largest distance, ``below_m`` how far the lowest lies under the plane, ``near_m`` the largest
    distance among those within 0.1 mm, and ``off_plane`` how many are not among them.
    """

    pixels: int = 0
    off_m: float = 0.0
    below_m: float = 0.0
    near_m: float = 0.0
    off_plane: int = 0


def largest_axis_excess(config: AuditedConfig, view: AuditedView) -> float:
    """Return how far the farthest steel pixel of both eyes lies from its bar's axis, in nominal radii.

    What a polyline's chords leave of a bend's arc is taken off: the bound is the same for every bar.
    """
    ratios = [axis_distance_ratio(eye.points_m, eye.bars, config.drawn_steel) for eye in view.eyes.values()]
    return max(float(found.max(initial=0.0)) for found in ratios)


def axis_distance_ratio(
    points_m: Float64[ndarray, "h w 3"], bars: UInt16[ndarray, "h w"], steel: Iterable[Bar]
) -> Float64[ndarray, " n"]:
    """Return each steel pixel's distance from its bar's centreline over the bar's nominal radius.

    Round the whole bar it is 1 give or take the ribs; on an end cap less. The sagitta of a bend's chords is taken
    off the distance.
    """
    axes = {bar.bar_id: bar for bar in steel}
    ratios = []
    for bar_id, on_bar_m in _points_by_bar(points_m, bars):
        if bar_id in axes:
            bar = axes[bar_id]
            axis_m = np.array(bar.axis_m)
            distance_m = polyline_distance_m(on_bar_m, axis_m) - bend_sagitta_m(axis_m)
            ratios.append(distance_m / (bar.diameter_m / 2))
    return np.concatenate(ratios) if ratios else np.zeros(0)


def bend_sagitta_m(axis_m: Float64[ndarray, "k 3"]) -> float:
    """Return how far a polyline's chords may lie from the arcs they stand for, metres; 0 for a straight bar.

    Where chords of length c follow each other at the angle a, their arc has the sagitta c/2 tan(a/4). The shorter
    neighbour is the chord: legs are longer. Corners of 15 degrees and more are no arcs.
    """
    chords = np.diff(axis_m, axis=0)
    lengths = np.linalg.norm(chords, axis=1)
    if len(lengths) < 2:
        return 0.0
    directions = chords / lengths[:, None]
    turn_rad = np.arccos(np.clip((directions[:-1] * directions[1:]).sum(axis=1), -1.0, 1.0))
    sagitta_m = np.minimum(lengths[:-1], lengths[1:]) / 2 * np.tan(turn_rad / 4)
    return float(sagitta_m[turn_rad < np.deg2rad(_ARC_CORNER_DEG)].max(initial=0.0))


def polyline_distance_m(
    points_m: Float64[ndarray, "n 3"], axis_m: Float64[ndarray, "k 3"]
) -> Float64[ndarray, " n"]:
    """Return the distance of points from the nearest of a polyline's segments, ends included, metres.

    Squares are expanded, so that matrix products do the work; points are taken relative to the polyline, whose
    extent squared then loses no digit that counts.
    """
    start_m, along = axis_m[:-1] - axis_m[0], np.diff(axis_m, axis=0)
    length_square = (along * along).sum(axis=1)
    start_along = (start_m * along).sum(axis=1)
    found = [np.zeros(0)]
    for first in range(0, len(points_m), _CHUNK):
        chunk_m = points_m[first : first + _CHUNK] - axis_m[0]
        from_start = chunk_m @ along.T - start_along  # (p - a) . d, for each point and segment
        square = (chunk_m * chunk_m).sum(axis=1, keepdims=True) - 2 * chunk_m @ start_m.T
        square += (start_m * start_m).sum(axis=1)
        share = np.clip(from_start / length_square, 0.0, 1.0)
        square += share * (share * length_square - 2 * from_start)
        found.append(np.sqrt(np.maximum(square.min(axis=1), 0.0)))
    return np.concatenate(found)


def axis_verdict(config: AuditedConfig, ratios: Sequence[float]) -> Check:
    """Hold the largest ratio of all views against what ribs allow; estimated axes are left out."""
    name, largest = f"{config.name}: steel on its bar's axis", max(ratios, default=0.0)
    found = f"at most {largest:.3f} radii"
    if not config.drawn_steel:
        return Check(name, "the axes are estimates", "left out")
    problem = f"a steel pixel lies {largest:.3f} nominal radii from its bar's axis"
    return Check(name, found, f"{MAX_AXIS_RATIO} radii", (problem,) if largest > MAX_AXIS_RATIO else ())


def largest_board_error(config: AuditedConfig, view: AuditedView) -> BoardError:
    """Return the board's errors in both eyes of a view; nothing where the scene has no board."""
    if config.board is None:
        return BoardError()
    return merged_board_errors([board_error(eye, config.board) for eye in view.eyes.values()])


def board_error(eye: AuditedEye, board: BoardSpec) -> BoardError:
    """Return how far from z = 0 the points lie that are not steel and stand over the board's known rectangle.

    A millimetre along its edge is left out: the sheet has sides.
    """
    x_m, y_m, z_m = np.moveaxis(eye.points_m, -1, 0)
    inside = (np.abs(x_m) < board.width_m / 2 - _BOARD_EDGE_M) & (np.abs(y_m) < board.height_m / 2 - _BOARD_EDGE_M)
    found_m = z_m[inside & ~eye.mask & (eye.depth_m > 0)]
    off_m = np.abs(found_m)
    near = off_m < _OCCLUDED_BOARD_M
    return BoardError(
        pixels=len(found_m),
        off_m=float(off_m.max(initial=0.0)),
        below_m=float((-found_m).max(initial=0.0)),
        near_m=float(off_m[near].max(initial=0.0)),
        off_plane=int(np.count_nonzero(~near)),
    )


def merged_board_errors(errors: Sequence[BoardError]) -> BoardError:
    """Return the largest distances and the sums of the counts."""
    return BoardError(
        pixels=sum(error.pixels for error in errors),
        off_m=max((error.off_m for error in errors), default=0.0),
        below_m=max((error.below_m for error in errors), default=0.0),
        near_m=max((error.near_m for error in errors), default=0.0),
        off_plane=sum(error.off_plane for error in errors),
    )


def board_verdict(config: AuditedConfig, errors: Sequence[BoardError]) -> Check:
    """Hold the board's points against z = 0.

    Where the scene has things they may stand on the board: there nothing may lie below it, most pixels
    lie on it, and what lies within 0.1 mm lies on it exactly.
    """
    name = f"{config.name}: board at z = 0"
    if config.board is None:
        return Check(name, "no board in this scene", "left out")
    all_views = merged_board_errors(errors)
    if not all_views.pixels:
        return Check(name, "no view sees the board", "left out")
    bound = f"{MAX_BOARD_ERROR_M * 1e6:g} um"
    if not config.has_things:
        found = f"at most {all_views.off_m * 1e6:.3f} um"
        return Check(name, found, bound, tuple(_off_the_plane(all_views.off_m)))
    share = all_views.off_plane / all_views.pixels
    found = f"at most {all_views.near_m * 1e6:.3f} um, {share:.1%} hidden by things on the board"
    problems = [*_off_the_plane(max(all_views.near_m, all_views.below_m))]
    if share > _MAX_OCCLUDED_SHARE:
        problems.append(
            f"{share:.1%} of the board's pixels lie above it, expected under {_MAX_OCCLUDED_SHARE:.0%}"
        )
    return Check(name, found, bound, tuple(problems))


def _off_the_plane(off_m: float) -> Iterator[str]:
    if off_m > MAX_BOARD_ERROR_M:
        yield f"a board pixel lies {off_m * 1e6:.3f} um from z = 0"


def _points_by_bar(
    points_m: Float64[ndarray, "h w 3"], bars: UInt16[ndarray, "h w"]
) -> Iterator[tuple[int, Float64[ndarray, "n 3"]]]:
    """Yield the bar ids in a picture with their pixels' points."""
    pixels = np.flatnonzero(bars)
    ids = bars.ravel()[pixels]
    order = np.argsort(ids, kind="stable")
    starts = np.flatnonzero(np.diff(ids[order], prepend=0))
    for run in np.split(order, starts[1:]) if len(starts) else ():
        yield int(ids[run[0]]), points_m.reshape(-1, 3)[pixels[run]]
