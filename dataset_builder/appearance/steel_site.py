"""What the makers of things round the steel know of a scene: where the steel is and what is taken. World, in m."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.appearance.bar_space import Capsules
from dataset_builder.model import Assembly, Bar, Part
from dataset_builder.specs import SceneSpec
from rebar_depth_bench.board import marker_corners_m

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
