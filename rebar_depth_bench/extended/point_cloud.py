"""Point cloud accuracy and completeness of the steel, at 5 and 10 mm.

After Knapitsch et al., "Tanks and Temples", ACM TOG 2017 (precision, recall and F-score of a reconstruction) and
Seitz et al., CVPR 2006 (accuracy, completeness), for the points of one view in the camera frame: the rays of
pixels at true and at predicted depth, ``x_cam = depth_m * (rays[:, 0], rays[:, 1], 1)``, with no alignment beyond
what the caller applied to the depth. At most ``MAX_POINTS`` interior pixels are queried, evenly, and their nearest
neighbours are sought among all pixels:

    accuracy[t]     = share of queried pixels whose predicted point is within t of a true point of the steel
    completeness[t] = share of queried pixels whose true point is within t of a predicted point of the interior
    F[t]            = 2 accuracy completeness / (accuracy + completeness), 0 where both are 0

A missing prediction contributes no point to completeness and is a failure in accuracy, so removing predictions
raises neither. The shares depend on the size of the image: in a larger one, points lie closer to each other, so
that a wrong point is nearer to the point of another pixel. At long range pixels are farther apart than t (17 mm at
12 m and 700 px focal length); a point then matches the point of its own pixel or none.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from rebar_depth_bench.extended.measures import Measure, Samples, subsample
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.scoring.metrics import is_valid_prediction

TOLERANCES_MM = (5, 10)
"""Distance tolerances t, ascending, in millimetres."""

MAX_POINTS = 4000
"""Maximum number of queried pixels per view; part of the definition of the measures."""

_SEARCH_RADIUS_M = 1.001 * TOLERANCES_MM[-1] / 1000  # the tree's bound is exclusive


@dataclass(frozen=True, eq=False)
class TrueCloud:
    """Queried pixels and true points of a view; they do not depend on a prediction.

    ``position`` holds the positions of the interior pixels in ``SteelTruth.index``, and ``queried`` the positions
    of the queried pixels among the interior ones. ``rays`` are ``(x/z, y/z, 1)`` of the interior pixels and
    ``z_m`` their true depth. ``steel_m`` are the true points of all steel pixels, metres in the camera frame.
    """

    position: Int64[ndarray, " n"]
    queried: Int64[ndarray, " m"]
    rays: Float64[ndarray, "n 3"]
    z_m: Float64[ndarray, " n"]
    steel_m: Float64[ndarray, "k 3"]

    @cached_property
    def tree(self) -> Any:
        """The k-d tree of ``steel_m``, built when it is needed."""
        return _build_tree(self.steel_m)


def true_cloud(truth: SteelTruth) -> TrueCloud:
    """Return the queried pixels and true points of a view."""
    position = np.flatnonzero(truth.interior)
    rays = np.concatenate([truth.rays, np.ones((len(truth.rays), 1))], axis=1)
    depth_m = truth.depth_m.astype(np.float64)
    steel = truth.interior | (truth.bar_id > 0)
    steel_m = rays[steel] * depth_m[steel, None]
    queried = subsample(np.arange(len(position)), MAX_POINTS)
    return TrueCloud(position, queried, rays[position], depth_m[position], steel_m)


def cloud_samples(p_m: Float64[ndarray, " n"], cloud: TrueCloud) -> Samples:
    """Return a view's point cloud samples.

    ``p_m`` is planar depth on the pixels of ``SteelTruth``, metres, NaN where missing.
    Each of ``cloud_accuracy_<t>mm``, ``cloud_completeness_<t>mm`` and ``cloud_f_<t>mm`` has one value from 0 to
    1, none where the view has no interior pixel.
    """
    count = len(cloud.queried)
    if not count:
        return {}
    accuracy_m, completeness_m = _distances_m(p_m[cloud.position], cloud)
    accuracy, completeness = _shares_within(accuracy_m, count), _shares_within(completeness_m, count)
    both = accuracy + completeness
    f = np.divide(2.0 * accuracy * completeness, both, out=np.zeros_like(both), where=both > 0)
    return {
        f"cloud_{kind}_{t}mm": values[i : i + 1]
        for kind, values in (("accuracy", accuracy), ("completeness", completeness), ("f", f))
        for i, t in enumerate(TOLERANCES_MM)
    }


def _distances_m(
    p_m: Float64[ndarray, " n"], cloud: TrueCloud
) -> tuple[Float64[ndarray, " k"], Float64[ndarray, " m"]]:
    """Return the distances in metres of queried predicted points to steel, and of true points to predicted ones.

    ``p_m`` is the prediction at the interior pixels. Points out of reach of every tolerance have an infinite
    distance or are left out of the first array. Where the two points of a pixel are within the smallest tolerance
    of each other, their distance is used instead of the nearest neighbour's: either counts at every tolerance.
    """
    steel_z_m, queried = cloud.steel_m[:, 2], cloud.queried
    in_range = is_valid_prediction(p_m)  # The distance of two points is at least their difference in planar depth.
    in_range &= (p_m > steel_z_m.min() - _SEARCH_RADIUS_M) & (p_m < steel_z_m.max() + _SEARCH_RADIUS_M)
    depth_m = np.where(in_range, p_m, np.inf)
    rays, queried_z_m, in_reach = cloud.rays[queried], cloud.z_m[queried], in_range[queried]
    own_m = np.abs(depth_m[queried] - queried_z_m) * np.sqrt(np.einsum("ij,ij->i", rays, rays))
    unmatched = own_m > TOLERANCES_MM[0] / 1000
    if not unmatched.any():
        return own_m, own_m
    predicted_m = rays[in_reach] * depth_m[queried][in_reach, None]
    accuracy_m = _nearest_m(cloud.tree, predicted_m, own_m[in_reach], unmatched[in_reach])
    tree = _build_tree(cloud.rays[in_range] * depth_m[in_range, None])
    return accuracy_m, _nearest_m(tree, rays * queried_z_m[:, None], own_m, unmatched)


def _nearest_m(
    tree: Any, points_m: Float64[ndarray, "m 3"], own_m: Float64[ndarray, " m"], look_up: Bool[ndarray, " m"]
) -> Float64[ndarray, " m"]:
    """Return each point's distance to its nearest neighbour in the tree, metres; inf beyond the search radius.

    ``own_m`` (the distance to the point of the same pixel) is returned where ``look_up`` is False.
    """
    distance_m = own_m.copy()
    if tree.n and look_up.any():
        distance_m[look_up] = tree.query(points_m[look_up], distance_upper_bound=_SEARCH_RADIUS_M)[0]
    return distance_m


def _build_tree(points_m: Float64[ndarray, "m 3"]) -> Any:
    """Return a k-d tree that is fast to build: it serves a single batch of queries."""
    from scipy.spatial import cKDTree  # Half a second to import, which reports and cards do not need.

    return cKDTree(points_m, leafsize=64, balanced_tree=False, compact_nodes=False)


def _shares_within(distance_m: Float64[ndarray, " m"], count: int) -> Float64[ndarray, " t"]:
    """Return the share of ``count`` points within each tolerance."""
    return np.array([np.count_nonzero(distance_m <= t / 1000) / count for t in TOLERANCES_MM])


_POINTS = f"share of interior pixels (at most {MAX_POINTS} a view, evenly)"

_KINDS = {
    "accuracy": (
        "accuracy",
        f"{_POINTS} whose predicted point is within {{}} mm of the true point of any steel pixel; a missing one "
        "is not; depends on the image size",
    ),
    "completeness": (
        "completeness",
        f"{_POINTS} whose true point is within {{}} mm of the predicted point of any interior pixel; depends on "
        "the image size",
    ),
    "f": (
        "F-score",
        "2 a c / (a + c) of accuracy a and completeness c at {} mm, view by view (Knapitsch et al. 2017)",
    ),
}
"""Title and definition of each share."""

MEASURES = tuple(
    Measure(f"cloud_{kind}_{t}mm", f"Cloud {title}, {t} mm", "%", "higher", definition.format(t))
    for kind, (title, definition) in _KINDS.items()
    for t in TOLERANCES_MM
)
"""Point cloud measures in table order."""
