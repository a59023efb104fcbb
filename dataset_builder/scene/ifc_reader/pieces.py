"""Pieces of a curve: straight legs, arcs of circles and ellipses, and sampled curves, in the file's length unit.

Each piece counts parameters as ISO 10303-42 does for the curve that it comes from, and can be cut exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

ARC_STEP_DEG = 6.0
"""Largest angle between sampled points of an arc, degrees, as in ``bent_line_m``."""


@dataclass(frozen=True, eq=False)
class Leg:
    """Straight leg; ``parameters`` is its parameter range: 1 in a polyline, else a multiple of a line's vector."""

    start: Float64[ndarray, " 3"]
    end: Float64[ndarray, " 3"]
    parameters: float

    @property
    def length(self) -> float:
        """Length of the leg."""
        return float(np.linalg.norm(self.end - self.start))

    def points(self) -> Float64[ndarray, "2 3"]:
        """Return both ends."""
        return np.array([self.start, self.end])

    def part(self, first: float, last: float) -> Leg:
        """Return the part between two shares (0 to 1) of the parameter range."""
        along = self.end - self.start
        start = self.start if first == 0 else self.start + first * along
        end = self.end if last == 1 else self.start + last * along
        return Leg(start, end, self.parameters * (last - first))

    def reversed(self) -> Leg:
        """Return the leg from its end to its start."""
        return replace(self, start=self.end, end=self.start)


@dataclass(frozen=True, eq=False)
class Arc:
    """Arc of a circle or an ellipse: centre + cos(t) x_axis + sin(t) y_axis for t from ``first_rad``.

    The arc turns by ``turn_rad``, which is negative if it runs clockwise about x_axis x y_axis. ``parameters`` is
    the turn's size in the project's plane angle unit.
    """

    centre: Float64[ndarray, " 3"]
    x_axis: Float64[ndarray, " 3"]
    y_axis: Float64[ndarray, " 3"]
    first_rad: float
    turn_rad: float
    parameters: float

    def points(self) -> Float64[ndarray, "n 3"]:
        """Return points at most ``ARC_STEP_DEG`` apart, including both ends."""
        count = max(2, int(np.ceil(np.rad2deg(abs(self.turn_rad)) / ARC_STEP_DEG - 1e-6)) + 1)
        angles_rad = self.first_rad + self.turn_rad * np.linspace(0.0, 1.0, count)[:, None]
        return np.asarray(self.centre + np.cos(angles_rad) * self.x_axis + np.sin(angles_rad) * self.y_axis)

    def part(self, first: float, last: float) -> Arc:
        """Return the part between two shares (0 to 1) of the parameter range."""
        share = last - first
        return replace(
            self,
            first_rad=self.first_rad + first * self.turn_rad,
            turn_rad=share * self.turn_rad,
            parameters=share * self.parameters,
        )

    def reversed(self) -> Arc:
        """Return the arc from its end to its start."""
        return replace(self, first_rad=self.first_rad + self.turn_rad, turn_rad=-self.turn_rad)


@dataclass(frozen=True, eq=False)
class Sampled:
    """Curve sampled at increasing ``shares`` (0 to 1) of its parameter range ``parameters``."""

    line: Float64[ndarray, "n 3"]
    shares: Float64[ndarray, " n"]
    parameters: float

    def points(self) -> Float64[ndarray, "n 3"]:
        """Return the sampled points."""
        return self.line

    def part(self, first: float, last: float) -> Sampled:
        """Return the part between two shares of the parameter range, interpolated at its ends."""
        inner = (self.shares > first) & (self.shares < last)
        at = np.concatenate([[first], self.shares[inner], [last]])
        line = np.stack([np.interp(at, self.shares, column) for column in self.line.T], axis=-1)
        return Sampled(line, (at - first) / (last - first), self.parameters * (last - first))

    def reversed(self) -> Sampled:
        """Return the curve from its end to its start."""
        return Sampled(self.line[::-1], 1 - self.shares[::-1], self.parameters)


Piece = Leg | Arc | Sampled


def arc_through(
    start: Float64[ndarray, " 3"], middle: Float64[ndarray, " 3"], end: Float64[ndarray, " 3"], angle_rad: float
) -> list[Piece]:
    """Return the circular arc from ``start`` through ``middle`` to ``end``, or two legs if they are collinear.

    The centre c solves |c - start|^2 = |c - end|^2 = |c - middle|^2 in the plane of the three points.
    ``angle_rad`` is the project's plane angle unit.
    """
    to_middle, to_end = middle - start, end - start
    normal = np.cross(to_middle, to_end)
    if np.linalg.norm(normal) <= 1e-9 * np.linalg.norm(to_middle) * np.linalg.norm(to_end):
        return [Leg(start, middle, 1.0), Leg(middle, end, 1.0)]
    x_axis = to_end / np.linalg.norm(to_end)
    y_axis = np.cross(normal, x_axis) / np.linalg.norm(normal)
    half = float(np.linalg.norm(to_end)) / 2
    x, y = float(to_middle @ x_axis), float(to_middle @ y_axis)
    centre_y = (x * x + y * y - 2 * half * x) / (2 * y)
    centre, radius = start + half * x_axis + centre_y * y_axis, float(np.hypot(half, centre_y))
    # By the choice of y_axis the middle has negative y, so the arc runs anticlockwise from start to end.
    first = float(np.arctan2(-centre_y, -half))
    turn = (float(np.arctan2(-centre_y, half)) - first) % (2 * np.pi)
    return [Arc(centre, radius * x_axis, radius * y_axis, first, turn, turn / angle_rad)]


def cut(pieces: list[Piece], ranges: list[float], first: float, last: float) -> list[Piece]:
    """Return the pieces between two values of a parameter that counts ``ranges[i]`` along piece i, from 0."""
    kept: list[Piece] = []
    begin = 0.0
    for piece, size in zip(pieces, ranges, strict=True):
        low, high = max(first - begin, 0.0), min(last - begin, size)
        if size > 0 and high > low:
            kept.append(piece.part(low / size, 1.0 if high == size else high / size))
        begin += size
    return kept
