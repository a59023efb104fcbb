"""Markers of methods, distinguishable without colour: filled or hollow shapes for archives, strokes for others."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

from rebar_depth_bench.reporting.figure.drawing import GREY, PAPER, Path, Point

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#a0488a", "#b07800", "#2f7f9f", "#000000")
"""Colours that people with colour blindness tell apart (after Okabe and Ito), dark enough for print."""

RADIUS = 3.6
"""Radius of a marker, points."""


def _ring(corners: int, first_deg: float, radii: Sequence[float] = (1.0,)) -> tuple[Point, ...]:
    """Return points around the origin, the first at an angle from the x axis; their radii repeat."""
    angles = [math.radians(first_deg + 360 * index / corners) for index in range(corners)]
    return tuple(
        (radii[index % len(radii)] * math.cos(angle), radii[index % len(radii)] * math.sin(angle))
        for index, angle in enumerate(angles)
    )


_CIRCLE = _ring(40, 0)
SHAPES: tuple[tuple[Point, ...], ...] = (
    _CIRCLE,
    _ring(4, 45, (1.2,)),
    _ring(3, -90, (1.3,)),
    _ring(4, 0, (1.25,)),
    _ring(3, 90, (1.3,)),
    _ring(10, -90, (1.4, 0.6)),
    _ring(3, 180, (1.3,)),
    _ring(3, 0, (1.3,)),
)
"""Circle, square, triangle up, diamond, triangle down, star, triangles left and right, of about the same area."""


def _spokes(*angles_deg: float) -> tuple[tuple[Point, ...], ...]:
    return tuple(
        ((0.0, 0.0), (math.cos(math.radians(angle)), math.sin(math.radians(angle)))) for angle in angles_deg
    )


STROKES: tuple[tuple[tuple[Point, ...], ...], ...] = (
    _spokes(0, 90, 180, 270),
    _spokes(45, 135, 225, 315),
    _spokes(30, 90, 150, 210, 270, 330),
    _spokes(90, 210, 330),
    _spokes(30, 150, 270),
    (*_spokes(0, 90, 180, 270), (*_CIRCLE, _CIRCLE[0])),
)
"""Plus, cross, star of six strokes, upright and upside-down Y, circle with a plus."""


def archive_marker(index: int, count: int, *, hollow: bool) -> tuple[Path, ...]:
    """Return the marker of the archive number ``index`` of ``count``.

    Shapes repeat after eight archives with a bar inside, and after sixteen with a dot. Later markers, which are
    drawn over earlier ones, are smaller, so that equal points show all of theirs.
    """
    radius = RADIUS * (1.15 - 0.3 * index / max(count - 1, 3))
    colour = COLOURS[index % len(COLOURS)]
    shape = _scaled(SHAPES[index % len(SHAPES)], radius)
    inside = colour if hollow else PAPER
    outline = Path(
        shape, colour if hollow else PAPER, 1.1 if hollow else 0.5, PAPER if hollow else colour, closed=True
    )
    variant: Literal["dot", "bar"] | None = (None, "bar", "dot")[index // len(SHAPES) % 3]
    if variant == "dot":
        return outline, Path(_scaled(_CIRCLE, 0.4 * radius), None, 0, inside, closed=True)
    if variant == "bar":
        return outline, Path(((-0.8 * radius, 0.0), (0.8 * radius, 0.0)), inside, 1.0)
    return (outline,)


def published_marker(index: int) -> tuple[Path, ...]:
    """Return the marker of the paper's method number ``index``."""
    return tuple(Path(_scaled(stroke, 3.1), GREY, 0.9) for stroke in STROKES[index % len(STROKES)])


def _scaled(points: Sequence[Point], factor: float) -> tuple[Point, ...]:
    return tuple((factor * x, factor * y) for x, y in points)
