"""What the makers of things round the steel know of a scene: where the steel is and what is taken. World, in m.

Where the bars of an assembly are, as capsules round their axes: what is near, what crosses. World, metres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from dataset_builder.config.specs import SceneSpec
from dataset_builder.scene.model import Assembly, Bar, Part
from dataset_builder.scene.shapes.bar_mesh import outer_radius_m, plain_outer_radius_m
from rebar_depth_bench.geometry.aruco_board import marker_corners_m

_PARALLEL = 1e-12


@dataclass(frozen=True, eq=False)
class Capsules:
    """Straight pieces of bars, each the points within ``radius_m`` of the piece of axis from ``a_m`` to ``b_m``.

    ``bar`` is the index of a piece's bar in the assembly. A radius holds ribs, so no steel is outside.
    """

    a_m: Float64[ndarray, "n 3"]
    b_m: Float64[ndarray, "n 3"]
    radius_m: Float64[ndarray, " n"]
    bar: Int64[ndarray, " n"]

    @classmethod
    def of(cls, bars: tuple[Bar, ...]) -> Capsules:
        """Return the capsules of ``bars``, in order."""
        lines = [np.asarray(bar.axis_m, dtype=np.float64) for bar in bars]
        pieces = np.array([len(line) - 1 for line in lines])
        return cls(
            np.concatenate([line[:-1] for line in lines]),
            np.concatenate([line[1:] for line in lines]),
            np.repeat([envelope_radius_m(bar.diameter_m) for bar in bars], pieces),
            np.repeat(np.arange(len(bars)), pieces),
        )

    def kept(self, which: Bool[ndarray, " n"]) -> Capsules:
        """Return the pieces that ``which`` marks."""
        return Capsules(self.a_m[which], self.b_m[which], self.radius_m[which], self.bar[which])

    def near(self, low_m: Float64[ndarray, " 3"], high_m: Float64[ndarray, " 3"]) -> Bool[ndarray, " n"]:
        """Return which pieces' own boxes meet the box from ``low_m`` to ``high_m``."""
        reach = self.radius_m[:, None]
        below = (np.minimum(self.a_m, self.b_m) - reach <= high_m).all(axis=1)
        above = (np.maximum(self.a_m, self.b_m) + reach >= low_m).all(axis=1)
        return np.asarray(below & above)

    def clearance_m(self, points_m: Float64[ndarray, "k 3"]) -> float:
        """Return the least distance from any of the points to any capsule's surface; infinity without capsules."""
        if not len(self.a_m):
            return float("inf")
        along = self.b_m - self.a_m
        from_a = points_m[:, None] - self.a_m
        share = np.clip(np.einsum("kni,ni->kn", from_a, along) / (along**2).sum(axis=1), 0.0, 1.0)
        off = np.linalg.norm(from_a - share[..., None] * along, axis=2) - self.radius_m
        return float(off.min())


@dataclass(frozen=True, eq=False)
class Crossing:
    """Two pieces (indices into the capsules) that pass each other, and the nearest points of their axes."""

    pieces: tuple[int, int]
    points_m: tuple[Float64[ndarray, " 3"], Float64[ndarray, " 3"]]


def crossings(capsules: Capsules, gap_m: float, least_angle_deg: float = 30.0) -> list[Crossing]:
    """Return where straight legs of different bars pass at ``gap_m`` or less between surfaces, steeply enough.

    Pieces no longer than two diameters belong to bends and are left out.
    """
    found = []
    legs = np.linalg.norm(capsules.b_m - capsules.a_m, axis=1) > 4 * capsules.radius_m
    low = np.minimum(capsules.a_m, capsules.b_m) - capsules.radius_m[:, None] - gap_m
    high = np.maximum(capsules.a_m, capsules.b_m) + capsules.radius_m[:, None] + gap_m
    for piece in np.flatnonzero(legs):
        later = legs & capsules.near(low[piece], high[piece]) & (capsules.bar > capsules.bar[piece])
        others = np.flatnonzero(later)
        if len(others):
            found += _crossings_of(int(piece), others, capsules, gap_m, np.deg2rad(least_angle_deg))
    return found


def _crossings_of(
    piece: int, others: Int64[ndarray, " k"], capsules: Capsules, gap_m: float, least_angle: float
) -> list[Crossing]:
    u = capsules.b_m[piece] - capsules.a_m[piece]
    v = capsules.b_m[others] - capsules.a_m[others]
    w = capsules.a_m[piece] - capsules.a_m[others]
    uu, uv, vv, uw, vw = u @ u, v @ u, (v * v).sum(axis=1), w @ u, (w * v).sum(axis=1)
    squared_sine = 1.0 - uv**2 / (uu * vv)
    steep = squared_sine > max(np.sin(least_angle) ** 2, _PARALLEL)
    across = np.where(steep, uu * vv - uv**2, 1.0)
    s, t = (uv * vw - vv * uw) / across, (uu * vw - uv * uw) / across
    # A crossing beyond either piece's end belongs to its neighbour, or to nobody.
    inside = (s >= 0) & (s < 1) & (t >= 0) & (t < 1)
    on_piece = capsules.a_m[piece] + s[:, None] * u
    on_other = capsules.a_m[others] + t[:, None] * v
    apart = np.linalg.norm(on_piece - on_other, axis=1)
    touching = (apart > _PARALLEL) & (apart - capsules.radius_m[piece] - capsules.radius_m[others] <= gap_m)
    which = np.flatnonzero(steep & inside & touching)
    return [Crossing((piece, int(others[k])), (on_piece[k], on_other[k])) for k in which]


@cache
def envelope_radius_m(diameter_m: float) -> float:
    """Return the distance from its axis that no point of a bar exceeds, ribbed or plain, metres."""
    return max(outer_radius_m(diameter_m), plain_outer_radius_m(diameter_m))


GAP_M = 5e-4
"""Things stand this far above the ground, and no surface of theirs lies in another's."""


@dataclass(frozen=True)
class Rect:
    """An upright rectangle of the ground plan, ``low_m`` and ``high_m`` its (x, y) corners."""

    low_m: tuple[float, float]
    high_m: tuple[float, float]

    def distance_m(self, points_m: Float64[ndarray, "k 2"]) -> Float64[ndarray, " k"]:
        """Return how far each (x, y) is from the rectangle, 0 inside."""
        outside = np.maximum(np.array(self.low_m) - points_m, points_m - np.array(self.high_m))
        return np.asarray(np.linalg.norm(np.maximum(outside, 0.0), axis=1))

    def grown(self, by_m: float) -> Rect:
        """Return the rectangle with every side moved out by ``by_m``."""
        (x0, y0), (x1, y1) = self.low_m, self.high_m
        return Rect((x0 - by_m, y0 - by_m), (x1 + by_m, y1 + by_m))


@dataclass(frozen=True, eq=False)
class Site:
    """The steel's bars and bounding box, the ground plan's taken places, and the scene's seed."""

    bars: tuple[Bar, ...]
    low_m: Float64[ndarray, " 3"]
    high_m: Float64[ndarray, " 3"]
    taken: tuple[Rect, ...]
    seed: int

    @classmethod
    def of(cls, assembly: Assembly, spec: SceneSpec) -> Site:
        """Return the site of an assembly; the board's markers are taken."""
        vertices_m = np.concatenate([part.mesh.vertices_m for part in assembly.parts])
        markers = marker_corners_m(spec.board).values() if spec.board else ()
        taken = tuple(_plan(corners_m) for corners_m in markers)
        return cls(assembly.bars, vertices_m.min(axis=0), vertices_m.max(axis=0), taken, spec.seed)

    def with_parts(self, parts: tuple[Part, ...]) -> Site:
        """Return the site with the ground plan of ``parts`` taken too."""
        return replace(self, taken=(*self.taken, *(_plan(part.mesh.vertices_m) for part in parts)))

    def random(self, what: str) -> np.random.Generator:
        """Return a generator that depends on the scene's seed and on ``what`` it is for, and on nothing else."""
        return np.random.default_rng([self.seed, *what.encode()])

    @cached_property
    def capsules(self) -> Capsules:
        """The steel as capsules round the bars' axes."""
        return Capsules.of(self.bars)

    @property
    def plan(self) -> Rect:
        """The steel's bounding box seen from above."""
        return Rect(_pair(self.low_m), _pair(self.high_m))

    @property
    def middle_m(self) -> Float64[ndarray, " 3"]:
        """The middle of the steel's bounding box."""
        return np.asarray((self.low_m + self.high_m) / 2)

    @property
    def size_m(self) -> Float64[ndarray, " 3"]:
        """The sides of the steel's bounding box."""
        return np.asarray(self.high_m - self.low_m)

    @property
    def span_m(self) -> float:
        """The longer horizontal side of the steel's bounding box: what things are scaled by."""
        return float(self.size_m[:2].max())

    @property
    def reach_m(self) -> float:
        """Half the diagonal of the steel's bounding box."""
        return float(np.linalg.norm(self.size_m) / 2)

    @property
    def thickest_m(self) -> float:
        """The largest bar diameter."""
        return max(bar.diameter_m for bar in self.bars)


def _plan(points_m: Float64[ndarray, "n 3"]) -> Rect:
    return Rect(_pair(points_m.min(axis=0)), _pair(points_m.max(axis=0)))


def _pair(point_m: Float64[ndarray, " 3"]) -> tuple[float, float]:
    return float(point_m[0]), float(point_m[1])
