"""Straight pieces of bars as capsules, and their distances; metres."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from dataset_builder.scene.shapes.bar_mesh import outer_radius_m, plain_outer_radius_m
from rebar_depth_bench.data.bars import Bar


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


@cache
def envelope_radius_m(diameter_m: float) -> float:
    """Return the maximum distance of the surface of a bar, ribbed or plain, from its axis, metres."""
    return max(outer_radius_m(diameter_m), plain_outer_radius_m(diameter_m))
