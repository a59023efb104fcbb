"""Matching of points with the crossings of a scene. Frame: the left camera's, metres.

Each point belongs to the nearest of all crossings of the scene, if that is within the limit. Of the points of a
crossing, the most confident one stands for it: it is correct if the crossing is judged in the view, and ignored if
it is not. All other points are false, apart from points on a bar whose axis, and so its crossings, is not known.
Points are matched in independent draws, as the random points are that give the level of chance.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from rebar_depth_bench.extended.judged import shown_pixels
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.geometry.cameras import transform

DETECTIONS_PROTOCOL = "rebar-crossings-2"
"""Version of the detectors' task; any change to a number changes it."""
LIMITS_MM = (2, 5, 10)
"""Largest distances of a detection from its crossing's tie point, mm."""
HEADLINE_MM = 5
"""Limit of precision, recall, F1 and errors, mm."""
NEAR_M = 0.020
"""Largest distance from the tie point, metres, of the detections that bias and spread describe."""
CHANCE_DRAWS = 100
"""Number of draws of random points in each view."""

SUMS = (
    *("crossings", "nodes", "detections", "matched", "false", "ignored", "near"),
    *("nodes_found", "right_mm", "down_mm", "along_mm", "square_mm2"),
)
"""What precision, recall, bias and spread are computed from: see ``Points.sums``."""

_ROUNDING = 1 + 1e-9


@dataclass(frozen=True, eq=False)
class ViewCrossings:
    """The n crossings of a scene in a view: tie points, ids of nodes, and whether each is judged.

    ``near_m`` is the distance within which points tell bias and spread: ``NEAR_M``, or half the distance to the
    next crossing.
    """

    tie_point_m: Float64[ndarray, "n 3"]
    node_id: Int64[ndarray, " n"]
    is_judged: Bool[ndarray, " n"]
    near_m: Float64[ndarray, " n"]

    @classmethod
    def of_view(cls, truth: SteelTruth) -> ViewCrossings:
        """Return the crossings of a view's scene in its camera frame."""
        from scipy.spatial import cKDTree

        scene = truth.bars.crossings.crossings
        tie_point_m = transform(truth.cam_from_world, scene.tie_point_m)
        is_judged = np.zeros(len(scene), dtype=bool)
        is_judged[truth.judged.crossing] = True
        near_m = np.full(len(scene), NEAR_M)
        if len(scene) > 1:
            near_m = np.minimum(near_m, cKDTree(tie_point_m).query(tie_point_m, k=2)[0][:, 1] / 2)
        return cls(tie_point_m, scene.node_id.astype(np.int64), is_judged, near_m)


@dataclass(frozen=True, eq=False)
class Points:
    """Points in d draws of n, with the nearest crossing and the distance from it.

    Where the scene has no crossing, the distance is infinite. ``on_unknown_bar`` marks the points that project
    onto a bar whose axis is not known.
    """

    point_m: Float64[ndarray, "d n 3"]
    nearest: Int64[ndarray, "d n"]
    distance_m: Float64[ndarray, "d n"]
    on_unknown_bar: Bool[ndarray, "d n"]

    @classmethod
    def in_view(cls, point_m: Float64[ndarray, "d n 3"], truth: SteelTruth, crossings: ViewCrossings) -> Points:
        """Return points with their nearest crossings and what the image shows of them."""
        from scipy.spatial import cKDTree

        distance_m, nearest = cKDTree(crossings.tie_point_m).query(point_m)
        shown = np.append(truth.bar_id, 0)[shown_pixels(truth, point_m.reshape(-1, 3))].reshape(nearest.shape)
        return cls(point_m, nearest, distance_m, (shown > 0) & np.isnan(truth.bars.diameter_m[shown]))

    def of(self, places: Int64[ndarray, " k"]) -> Points:
        """Return some of the points of each draw."""
        return Points(
            self.point_m[:, places],
            self.nearest[:, places],
            self.distance_m[:, places],
            self.on_unknown_bar[:, places],
        )

    def match(
        self, crossings: ViewCrossings, confidence: Float64[ndarray, " n"], limit_m: float
    ) -> tuple[Bool[ndarray, "d n"], Bool[ndarray, "d n"]]:
        """Return which points are correct, and which are ignored.

        Of equally confident points, the nearest to the crossing stands for it, so that the order of points has an
        effect only among those at the same distance.
        """
        draw, point = np.nonzero(self.distance_m <= limit_m * _ROUNDING)
        crossing = self.nearest[draw, point]
        order = np.lexsort((self.distance_m[draw, point], -confidence[point]))
        _, first = np.unique((draw * len(crossings.near_m) + crossing)[order], return_index=True)
        stands = order[first]
        chosen, correct = np.zeros((2, *self.nearest.shape), dtype=bool)
        chosen[draw[stands], point[stands]] = True
        correct[draw[stands], point[stands]] = crossings.is_judged[crossing[stands]]
        return correct, ~correct & (chosen | self.on_unknown_bar)

    def sums(
        self, crossings: ViewCrossings, correct: Bool[ndarray, "d n"], ignored: Bool[ndarray, "d n"]
    ) -> dict[str, Float64[ndarray, " d"]]:
        """Return the ``SUMS`` of each draw.

        ``nodes_found`` counts nodes with a correct point. ``near`` counts the points within ``near_m`` of a judged
        crossing; the others are sums over these of the offsets from the tie point along the axes of the camera
        (x: right, y: down, z: away), mm, and of the squared distances, mm^2.
        """
        draws, judged = len(correct), crossings.is_judged
        draw, point = np.nonzero(correct)
        nodes = np.column_stack([draw, crossings.node_id[self.nearest[draw, point]]])
        sums = {
            "crossings": np.full(draws, np.count_nonzero(judged)),
            "nodes": np.full(draws, len(np.unique(crossings.node_id[judged]))),
            "detections": np.full(draws, correct.shape[1]),
            "matched": np.count_nonzero(correct, axis=1),
            "false": np.count_nonzero(~(correct | ignored), axis=1),
            "ignored": np.count_nonzero(ignored, axis=1),
            "nodes_found": np.bincount(np.unique(nodes, axis=0)[:, 0], minlength=draws),
        }
        draw, point = np.nonzero(self.distance_m <= NEAR_M * _ROUNDING)
        crossing, distance_m = self.nearest[draw, point], self.distance_m[draw, point]
        near = judged[crossing] & (distance_m <= crossings.near_m[crossing] * _ROUNDING)
        draw, point, crossing = draw[near], point[near], crossing[near]
        offset_mm = 1000 * (self.point_m[draw, point] - crossings.tie_point_m[crossing])
        sums["near"] = np.bincount(draw, minlength=draws)
        for name, values in zip(("right_mm", "down_mm", "along_mm"), offset_mm.T, strict=True):
            sums[name] = np.bincount(draw, values, draws)
        sums["square_mm2"] = np.bincount(draw, (offset_mm**2).sum(axis=1), draws)
        return {name: values.astype(np.float64) for name, values in sums.items()}


def random_points(truth: SteelTruth, count: int) -> Float64[ndarray, "d count 3"]:
    """Return ``CHANCE_DRAWS`` draws of random points on the surface of the scored pixels, camera frame, metres.

    The same view id gives the same points on every machine; fewer points are the first ones of more.
    """
    pixels = np.flatnonzero(truth.interior)
    seed = int.from_bytes(hashlib.sha256(truth.view_id.encode()).digest()[:8], "little")
    numbers = np.random.PCG64(seed).random_raw(CHANCE_DRAWS * count).reshape(count, CHANCE_DRAWS).T
    chosen = pixels[(numbers % len(pixels)).astype(np.int64)]
    rays = np.concatenate([truth.rays[chosen], np.ones((*chosen.shape, 1))], axis=-1)
    return np.asarray(truth.depth_m[chosen].astype(np.float64)[..., None] * rays)
