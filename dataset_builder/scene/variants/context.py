"""Placement context of props: bounding box of the steel, occupied ground regions, and bars as capsules.

World frame, metres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.model import Assembly, Part
from dataset_builder.scene.shapes.bar_mesh import outer_radius_m
from dataset_builder.scene.shapes.capsules import Capsules
from dataset_builder.specs.config_specs import GeneratedCageSpec, SceneSpec
from rebar_depth_bench.data.bars import Bar, with_axis
from rebar_depth_bench.geometry.aruco_board import marker_corners_m

GAP_M = 5e-4
"""Height of props above the ground, metres, so that no two surfaces coincide."""


@dataclass(frozen=True, eq=False)
class Rect:
    """Axis-aligned rectangle on the ground; ``low_m`` and ``high_m`` are its (x, y) corners, metres."""

    low_m: Float64[ndarray, " 2"]
    high_m: Float64[ndarray, " 2"]

    @classmethod
    def of_points(cls, points_m: Float64[ndarray, "n 3"]) -> Rect:
        """Return the bounding box of points seen from above."""
        return cls(points_m[:, :2].min(axis=0), points_m[:, :2].max(axis=0))

    def distance_m(self, points_m: Float64[ndarray, "k 2"]) -> Float64[ndarray, " k"]:
        """Return the distance of each (x, y) point from the rectangle, metres; 0 inside."""
        outside = np.maximum(self.low_m - points_m, points_m - self.high_m)
        return np.asarray(np.linalg.norm(np.maximum(outside, 0.0), axis=1))

    def expanded(self, by_m: float) -> Rect:
        """Return the rectangle with every side moved outwards by ``by_m``."""
        return Rect(self.low_m - by_m, self.high_m + by_m)


@dataclass(frozen=True, eq=False)
class PlacementContext:
    """Bars with an axis and bounding box of all steel, occupied ground rectangles, and seed of the scene.

    ``environment`` is that of the scene. Props have their real sizes (``is_life_size``) beside a generated cage;
    others are scaled with the steel.
    """

    bars: tuple[Bar, ...]
    low_m: Float64[ndarray, " 3"]
    high_m: Float64[ndarray, " 3"]
    occupied: tuple[Rect, ...]
    seed: int
    environment: str
    is_life_size: bool

    @classmethod
    def from_assembly(cls, assembly: Assembly, spec: SceneSpec) -> PlacementContext:
        """Return the context of an assembly; the markers of the board are occupied."""
        vertices_m = assembly.vertices_m
        markers = marker_corners_m(spec.board).values() if spec.board else ()
        occupied = tuple(map(Rect.of_points, markers))
        low_m, high_m = vertices_m.min(axis=0), vertices_m.max(axis=0)
        is_generated = isinstance(spec.assembly, GeneratedCageSpec)
        return cls(with_axis(assembly.bars), low_m, high_m, occupied, spec.seed, spec.environment, is_generated)

    def with_parts(self, parts: tuple[Part, ...]) -> PlacementContext:
        """Return the context in which the footprints of ``parts`` are occupied too."""
        return replace(self, occupied=(*self.occupied, *(Rect.of_points(part.mesh.vertices_m) for part in parts)))

    def rng(self, purpose: str) -> np.random.Generator:
        """Return a random generator that depends only on the seed of the scene and on ``purpose``."""
        return np.random.default_rng([self.seed, *purpose.encode()])

    @cached_property
    def capsules(self) -> Capsules:
        """Capsules around the axes of the bars, which enclose all steel with its ribs."""
        lines = [np.array(bar.axis_m, dtype=np.float64) for bar in self.bars]
        return Capsules.of_lines(lines, [outer_radius_m(bar.diameter_m) for bar in self.bars])

    @property
    def footprint(self) -> Rect:
        """Bounding box of the steel seen from above."""
        return Rect(self.low_m[:2], self.high_m[:2])

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
