"""Placement context of props: bounding box of the steel, occupied ground regions, and bars as capsules.

World frame, metres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from dataset_builder.config.specs import SceneSpec
from dataset_builder.scene.model import Assembly, Part
from dataset_builder.scene.shapes.bar_mesh import outer_radius_m, plain_outer_radius_m
from rebar_depth_bench.data.bars import Bar, with_axis
from rebar_depth_bench.geometry.aruco_board import marker_corners_m

MIN_CROSSING_ANGLE_DEG = 30.0
"""Smallest angle between the axes of a crossing, degrees."""
_EPSILON = 1e-12
"""Smallest distance between the axes of a crossing, metres."""


@dataclass(frozen=True, eq=False)
class Capsules:
    """Straight pieces of bars as capsules: all points within ``radius_m`` of the segment from ``a_m`` to ``b_m``.

    ``bar`` is the index of the bar of each piece in the assembly. The radii include the ribs, so the capsules
    enclose all steel.
    """

    a_m: Float64[ndarray, "n 3"]
    b_m: Float64[ndarray, "n 3"]
    radius_m: Float64[ndarray, " n"]
    bar: Int64[ndarray, " n"]

    @classmethod
    def from_bars(cls, bars: tuple[Bar, ...]) -> Capsules:
        """Return the capsules of ``bars``, in order."""
        lines = [np.asarray(bar.axis_m, dtype=np.float64) for bar in bars]
        pieces = np.array([len(line) - 1 for line in lines], dtype=np.int64)
        return cls(
            np.concatenate([np.zeros((0, 3)), *(line[:-1] for line in lines)]),
            np.concatenate([np.zeros((0, 3)), *(line[1:] for line in lines)]),
            np.repeat([envelope_radius_m(bar.diameter_m) for bar in bars], pieces),
            np.repeat(np.arange(len(bars)), pieces),
        )

    def select(self, which: Bool[ndarray, " n"]) -> Capsules:
        """Return the pieces selected by the mask ``which``."""
        return Capsules(self.a_m[which], self.b_m[which], self.radius_m[which], self.bar[which])

    def overlapping(self, low_m: Float64[ndarray, " 3"], high_m: Float64[ndarray, " 3"]) -> Bool[ndarray, " n"]:
        """Return the mask of pieces whose bounding box intersects the box from ``low_m`` to ``high_m``."""
        reach = self.radius_m[:, None]
        below = (np.minimum(self.a_m, self.b_m) - reach <= high_m).all(axis=1)
        above = (np.maximum(self.a_m, self.b_m) + reach >= low_m).all(axis=1)
        return np.asarray(below & above)

    def clearance_m(self, points_m: Float64[ndarray, "k 3"]) -> float:
        """Return the smallest signed distance of the points to the capsules, metres; infinity for no capsules."""
        if not len(self.a_m):
            return float("inf")
        along = self.b_m - self.a_m
        from_a = points_m[:, None] - self.a_m
        share = np.clip(np.einsum("kni,ni->kn", from_a, along) / (along**2).sum(axis=1), 0.0, 1.0)
        off = np.linalg.norm(from_a - share[..., None] * along, axis=2) - self.radius_m
        return float(off.min())


@dataclass(frozen=True, eq=False)
class Crossing:
    """Crossing of two pieces (indices into the capsules), with the closest points of their axes."""

    pieces: tuple[int, int]
    points_m: tuple[Float64[ndarray, " 3"], Float64[ndarray, " 3"]]


def find_crossings(capsules: Capsules, gap_m: float) -> list[Crossing]:
    """Return the crossings of straight legs of different bars.

    Their surfaces are at most ``gap_m`` apart. Pieces of at most two diameters belong to bends and are omitted.
    """
    crossings = []
    legs = np.linalg.norm(capsules.b_m - capsules.a_m, axis=1) > 4 * capsules.radius_m
    low = np.minimum(capsules.a_m, capsules.b_m) - capsules.radius_m[:, None] - gap_m
    high = np.maximum(capsules.a_m, capsules.b_m) + capsules.radius_m[:, None] + gap_m
    for piece in np.flatnonzero(legs):
        later = legs & capsules.overlapping(low[piece], high[piece]) & (capsules.bar > capsules.bar[piece])
        others = np.flatnonzero(later)
        if len(others):
            crossings += _crossings_of(int(piece), others, capsules, gap_m)
    return crossings


def _crossings_of(piece: int, others: Int64[ndarray, " k"], capsules: Capsules, gap_m: float) -> list[Crossing]:
    u = capsules.b_m[piece] - capsules.a_m[piece]
    v = capsules.b_m[others] - capsules.a_m[others]
    w = capsules.a_m[piece] - capsules.a_m[others]
    uu, uv, vv, uw, vw = u @ u, v @ u, (v * v).sum(axis=1), w @ u, (w * v).sum(axis=1)
    squared_sine = 1.0 - uv**2 / (uu * vv)
    steep = squared_sine > np.sin(np.deg2rad(MIN_CROSSING_ANGLE_DEG)) ** 2
    across = np.where(steep, uu * vv - uv**2, 1.0)
    s, t = (uv * vw - vv * uw) / across, (uu * vw - uv * uw) / across
    # A closest point beyond the end of a piece is a crossing of the adjacent piece, or no crossing.
    inside = (s >= 0) & (s < 1) & (t >= 0) & (t < 1)
    on_piece = capsules.a_m[piece] + s[:, None] * u
    on_other = capsules.a_m[others] + t[:, None] * v
    apart = np.linalg.norm(on_piece - on_other, axis=1)
    close = (apart > _EPSILON) & (apart - capsules.radius_m[piece] - capsules.radius_m[others] <= gap_m)
    which = np.flatnonzero(steep & inside & close)
    return [Crossing((piece, int(others[k])), (on_piece[k], on_other[k])) for k in which]


@cache
def envelope_radius_m(diameter_m: float) -> float:
    """Return the maximum distance of the surface of a bar, ribbed or plain, from its axis, metres."""
    return max(outer_radius_m(diameter_m), plain_outer_radius_m(diameter_m))


GAP_M = 5e-4
"""Height of props above the ground, metres, so that no two surfaces coincide."""


@dataclass(frozen=True)
class Rect:
    """Axis-aligned rectangle on the ground; ``low_m`` and ``high_m`` are its (x, y) corners, metres."""

    low_m: tuple[float, float]
    high_m: tuple[float, float]

    def distance_m(self, points_m: Float64[ndarray, "k 2"]) -> Float64[ndarray, " k"]:
        """Return the distance of each (x, y) point from the rectangle, metres; 0 inside."""
        outside = np.maximum(np.array(self.low_m) - points_m, points_m - np.array(self.high_m))
        return np.asarray(np.linalg.norm(np.maximum(outside, 0.0), axis=1))

    def expanded(self, by_m: float) -> Rect:
        """Return the rectangle with every side moved outwards by ``by_m``."""
        (x0, y0), (x1, y1) = self.low_m, self.high_m
        return Rect((x0 - by_m, y0 - by_m), (x1 + by_m, y1 + by_m))


@dataclass(frozen=True, eq=False)
class PlacementContext:
    """Bars with an axis and bounding box of all steel, occupied ground rectangles, and seed of the scene.

    ``environment`` is that of the scene.
    """

    bars: tuple[Bar, ...]
    low_m: Float64[ndarray, " 3"]
    high_m: Float64[ndarray, " 3"]
    occupied: tuple[Rect, ...]
    seed: int
    environment: str

    @classmethod
    def from_assembly(cls, assembly: Assembly, spec: SceneSpec) -> PlacementContext:
        """Return the context of an assembly; the markers of the board are occupied."""
        vertices_m = assembly.vertices_m
        markers = marker_corners_m(spec.board).values() if spec.board else ()
        occupied = tuple(_footprint(corners_m) for corners_m in markers)
        low_m, high_m = vertices_m.min(axis=0), vertices_m.max(axis=0)
        return cls(with_axis(assembly.bars), low_m, high_m, occupied, spec.seed, spec.environment)

    def with_parts(self, parts: tuple[Part, ...]) -> PlacementContext:
        """Return the context in which the footprints of ``parts`` are occupied too."""
        return replace(self, occupied=(*self.occupied, *(_footprint(part.mesh.vertices_m) for part in parts)))

    def rng(self, purpose: str) -> np.random.Generator:
        """Return a random generator that depends only on the seed of the scene and on ``purpose``."""
        return np.random.default_rng([self.seed, *purpose.encode()])

    @cached_property
    def capsules(self) -> Capsules:
        """Capsules around the axes of the bars."""
        return Capsules.from_bars(self.bars)

    @property
    def footprint(self) -> Rect:
        """Bounding box of the steel seen from above."""
        return Rect(_xy(self.low_m), _xy(self.high_m))

    @property
    def middle_m(self) -> Float64[ndarray, " 3"]:
        """Centre of the bounding box of the steel."""
        return np.asarray((self.low_m + self.high_m) / 2)

    @property
    def size_m(self) -> Float64[ndarray, " 3"]:
        """Side lengths of the bounding box of the steel."""
        return np.asarray(self.high_m - self.low_m)

    @property
    def span_m(self) -> float:
        """Longer horizontal side of the bounding box of the steel, by which props are scaled."""
        return float(self.size_m[:2].max())

    @property
    def reach_m(self) -> float:
        """Half the diagonal of the bounding box of the steel."""
        return float(np.linalg.norm(self.size_m) / 2)

    @property
    def thickest_m(self) -> float:
        """Largest bar diameter."""
        return max((bar.diameter_m for bar in self.bars), default=0.0)


def _footprint(points_m: Float64[ndarray, "n 3"]) -> Rect:
    return Rect(_xy(points_m.min(axis=0)), _xy(points_m.max(axis=0)))


def _xy(point_m: Float64[ndarray, " 3"]) -> tuple[float, float]:
    return float(point_m[0]), float(point_m[1])
