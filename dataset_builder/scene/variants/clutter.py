"""Clutter props: objects on the ground around the steel, scaled with it or life-size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.model import Mesh, Part, surface
from dataset_builder.scene.shapes.solids import Point, box, lathe, rotation_about_z, transformed
from dataset_builder.scene.variants.context import GAP_M, PlacementContext, Rect

CLEARANCE = 0.04
"""Minimum distance between clutter and the bounding box of the steel, as a fraction of the steel's span."""
MAX_TRIES = 400
"""Maximum number of rng positions tried per object."""

Piece = tuple[Mesh, str]
"""Mesh and material name."""


@dataclass(frozen=True)
class _Item:
    """Object to place: name, footprint (length, width) and pieces.

    The pieces are in a local frame with the origin at the centre of the footprint.
    """

    name: str
    footprint_m: tuple[float, float]
    pieces: list[Piece]


LIFE_SIZE_UNIT_M = 0.36
"""Unit of life-size objects: the buckets are 0.3 m high."""
LIFE_SIZE_BAND_M = 1.6
"""Width of the band round the steel in which life-size objects lie."""


def clutter(context: PlacementContext) -> tuple[Part, ...]:
    """Return the objects, placed clear of the steel, the markers, earlier props and each other.

    All scaled objects are within 0.9 spans (at most 0.7 m) of the bounding box of the steel and at most 0.23 spans
    high, life-size ones within ``LIFE_SIZE_BAND_M`` and at most 0.3 m high. Objects for which no free position is
    found are omitted.
    """
    unit_m, band_m = float(np.clip(0.25 * context.span_m, 0.015, 0.4)), min(0.9 * context.span_m, 0.7)
    if context.is_life_size:
        unit_m, band_m = LIFE_SIZE_UNIT_M, LIFE_SIZE_BAND_M
    rng = context.rng("clutter")
    allowed = context.footprint.expanded(band_m)
    blocked = (context.footprint.expanded(CLEARANCE * context.span_m), *context.occupied)
    circles: list[tuple[Float64[ndarray, "k 2"], float]] = []
    parts: list[Part] = []
    for number, item in enumerate(_items(unit_m)):
        pose = _find_pose(item, allowed, blocked, circles, rng)
        if pose is not None:
            at_m, turn_deg = pose
            circles.append(_covering_circles(item, at_m, turn_deg))
            for k, (mesh, material) in enumerate(item.pieces):
                placed_mesh = transformed(mesh, rotation_about_z(turn_deg), (at_m[0], at_m[1], GAP_M))
                parts.append(surface(f"clutter-{number}-{item.name}-{k}", placed_mesh, material))
    return tuple(parts)


def _find_pose(
    item: _Item,
    allowed: Rect,
    blocked: tuple[Rect, ...],
    circles: list[tuple[Float64[ndarray, "k 2"], float]],
    rng: np.random.Generator,
) -> tuple[Float64[ndarray, " 2"], float] | None:
    for _ in range(MAX_TRIES):
        at_m, turn_deg = rng.uniform(allowed.low_m, allowed.high_m), float(rng.uniform(0.0, 360.0))
        points_m, radius_m = _covering_circles(item, at_m, turn_deg)
        if (points_m - radius_m < allowed.low_m).any() or (points_m + radius_m > allowed.high_m).any():
            continue
        if any(rect.distance_m(points_m).min() < radius_m for rect in blocked):
            continue
        if all(_min_distance_m(points_m, others_m) > radius_m + other_m for others_m, other_m in circles):
            return at_m, turn_deg
    return None


def _covering_circles(
    item: _Item, at_m: Float64[ndarray, " 2"], turn_deg: float
) -> tuple[Float64[ndarray, "k 2"], float]:
    """Return the centres and the common radius of a row of circles that cover the footprint of the item."""
    length_m, width_m = item.footprint_m
    count = int(np.ceil(length_m / width_m))
    along_m = ((np.arange(count) + 0.5) / count - 0.5) * length_m
    axis = rotation_about_z(turn_deg)[:2, 0]
    return at_m + along_m[:, None] * axis, 1.05 * float(np.hypot(width_m, length_m / count)) / 2


def _min_distance_m(points_m: Float64[ndarray, "k 2"], others_m: Float64[ndarray, "j 2"]) -> float:
    return float(np.linalg.norm(points_m[:, None] - others_m, axis=2).min())


def _items(u: float) -> tuple[_Item, ...]:
    """Return the objects to place, largest first, with dimensions in units of ``u`` metres."""
    return (
        _slab("offcut", (3.2 * u, 0.5 * u, 0.18 * u), "timber"),
        _slab("batten", (2.1 * u, 0.26 * u, 0.26 * u), "timber"),
        _Item("bucket", (0.92 * u, 0.92 * u), [(_bucket(u), "black rubber")]),
        _slab("box", (0.95 * u, 0.62 * u, 0.4 * u), "cardboard"),
        _Item("bucket", (0.78 * u, 0.78 * u), [(_bucket(0.85 * u), "blue plastic")]),
        _Item("hammer", (1.35 * u, 0.42 * u), _hammer(u)),
        _slab("block", (0.8 * u, 0.4 * u, 0.4 * u), "concrete"),
        _slab("glove", (0.62 * u, 0.3 * u, 0.1 * u), "orange plastic"),
        _Item("tape", (0.5 * u, 0.5 * u), [(_tape(u), "red paint")]),
        _slab("offcut", (1.3 * u, 0.5 * u, 0.18 * u), "timber"),
        _slab("block", (0.5 * u, 0.4 * u, 0.3 * u), "concrete"),
        _Item("tape", (0.5 * u, 0.5 * u), [(_tape(u), "grey plastic")]),
    )


def _slab(name: str, size_m: Point, material: str) -> _Item:
    """Return a box of one material."""
    length_m, width_m, height_m = size_m
    mesh = box((-length_m / 2, -width_m / 2, 0.0), (length_m / 2, width_m / 2, height_m))
    return _Item(name, (length_m, width_m), [(mesh, material)])


def _bucket(u: float) -> Mesh:
    """Return an open bucket that widens towards its rim."""
    outline = [(0.01, 0.0), (0.33, 0.0), (0.44, 0.82), (0.41, 0.82), (0.31, 0.03), (0.01, 0.03)]
    return lathe(u * np.array(outline), 40)


def _tape(u: float) -> Mesh:
    outline = [(0.16, 0.0), (0.24, 0.0), (0.24, 0.16), (0.16, 0.16)]
    return lathe(u * np.array(outline), 40)


def _hammer(u: float) -> list[Piece]:
    """Return a hammer lying on its side; the handle ends inside the head."""
    outline = [(0.005, -0.65), (0.055, -0.65), (0.045, 0.5), (0.005, 0.5)]
    rotation = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    handle = transformed(lathe(u * np.array(outline), 16), rotation, (0.0, 0.0, 0.08 * u))
    head = box((0.42 * u, -0.2 * u, 0.0), (0.6 * u, 0.2 * u, 0.16 * u))
    return [(handle, "timber"), (head, "dark laminate")]
