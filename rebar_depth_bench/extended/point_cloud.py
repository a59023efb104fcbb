"""Point cloud accuracy and completeness of the steel, at 1, 2, 5, 10 and 20 mm.

After Knapitsch et al., "Tanks and Temples", ACM TOG 2017 (precision, recall and F-score of a reconstruction) and
Seitz et al., CVPR 2006 (accuracy, completeness), for the points of one view in the camera frame: the rays of the
interior pixels at true and at predicted depth, ``x_cam = depth_m * (rays[:, 0], rays[:, 1], 1)``, with no
alignment beyond what the caller applied to the depth. Both clouds use the same pixels, at most ``MAX_POINTS``, so
that a perfect prediction scores 1:

    accuracy[t]     = share of the pixels whose predicted point is within t of a true point
    completeness[t] = share of the pixels whose true point is within t of a predicted point
    F[t]            = 2 accuracy completeness / (accuracy + completeness), 0 where both are 0

A missing prediction contributes no point to completeness and is a failure in accuracy, so removing predictions
raises neither. A sparser cloud has more distant neighbours and thus lower shares at small t: ``MAX_POINTS`` is
part of the definition. At long range pixels are farther apart than t (17 mm at 12 m and 700 px focal length); a
point then matches the point of its own pixel or none.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from rebar_depth_bench.extended.measures import Measure, Samples, subsample
from rebar_depth_bench.extended.steel_truth import SteelTruth
from rebar_depth_bench.scoring.metrics import is_valid_prediction

TOLERANCES_MM = (1, 2, 5, 10, 20)
"""Distance tolerances t, ascending, in millimetres."""

MAX_POINTS = 4000
"""Maximum number of pixels per view; part of the definition of the measures."""


_SEARCH_RADIUS_M = 1.001 * TOLERANCES_MM[-1] / 1000  # the tree's bound is exclusive


@dataclass(frozen=True, eq=False)
class TrueCloud:
    """True points of a view and their k-d tree.

    ``points_m`` are in the camera frame, metres; ``position`` holds their positions in ``SteelTruth.index``;
    ``rays`` are ``(x/z, y/z, 1)``.
    """

    position: Int64[ndarray, " m"]
    rays: Float64[ndarray, "m 3"]
    points_m: Float64[ndarray, "m 3"]
    tree: Any


def true_cloud(truth: SteelTruth) -> TrueCloud:
    """Return the subsampled true points of a view's interior; they do not depend on a prediction."""
    position = subsample(np.flatnonzero(truth.interior), MAX_POINTS)
    rays = np.concatenate([truth.rays[position], np.ones((len(position), 1))], axis=1)
    points_m = rays * truth.depth_m[position, None].astype(np.float64)
    return TrueCloud(position, rays, points_m, _build_tree(points_m))


def cloud_samples(p_m: Float64[ndarray, " n"], truth: SteelTruth, cloud: TrueCloud | None = None) -> Samples:
    """Return a view's point cloud samples; ``p_m`` is planar depth on ``truth.index``, metres, NaN where missing.

    Each of ``cloud_accuracy_<t>mm``, ``cloud_completeness_<t>mm`` and ``cloud_f_<t>mm`` has one value from 0 to
    1, none where the view has no interior pixel. ``cloud`` is ``true_cloud(truth)``, if already computed.
    """
    cloud = cloud or true_cloud(truth)
    count = len(cloud.position)
    kinds = dict.fromkeys(("accuracy", "completeness", "f"), np.empty(0))
    if count:
        accuracy_m, completeness_m = _distances_m(p_m[cloud.position], cloud)
        accuracy, completeness = _shares_within(accuracy_m, count), _shares_within(completeness_m, count)
        both = accuracy + completeness
        f = np.divide(2.0 * accuracy * completeness, both, out=np.zeros_like(both), where=both > 0)
        kinds = {"accuracy": accuracy, "completeness": completeness, "f": f}
    return {
        f"cloud_{kind}_{t}mm": values[i : i + 1]
        for kind, values in kinds.items()
        for i, t in enumerate(TOLERANCES_MM)
    }


def _distances_m(
    p_m: Float64[ndarray, " m"], cloud: TrueCloud
) -> tuple[Float64[ndarray, " k"], Float64[ndarray, " m"]]:
    """Return the distances of predicted points to the true cloud and of true points to the predicted one, metres.

    ``p_m`` is the prediction at the cloud's pixels. Points out of reach of every tolerance have an infinite
    distance or are left out of the first array. Where the two points of a pixel are within the smallest tolerance
    of each other, their distance is used instead of the nearest neighbour's: either counts at every tolerance.
    """
    z_m = cloud.points_m[:, 2]
    in_range = is_valid_prediction(p_m)  # The distance of two points is at least their difference in planar depth.
    in_range &= (p_m > z_m.min() - _SEARCH_RADIUS_M) & (p_m < z_m.max() + _SEARCH_RADIUS_M)
    depth_m = np.where(in_range, p_m, np.inf)
    own_m = np.abs(depth_m - z_m) * np.sqrt(np.einsum("ij,ij->i", cloud.rays, cloud.rays))
    unmatched = own_m > TOLERANCES_MM[0] / 1000
    points_m = cloud.rays[in_range] * depth_m[in_range, None]
    accuracy_m = _nearest_m(cloud.tree, points_m, own_m[in_range], unmatched[in_range])
    if not unmatched.any():
        return accuracy_m, own_m
    return accuracy_m, _nearest_m(_build_tree(points_m), cloud.points_m, own_m, unmatched)


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

    return cKDTree(points_m, balanced_tree=False, compact_nodes=False)


def _shares_within(distance_m: Float64[ndarray, " m"], count: int) -> Float64[ndarray, " t"]:
    """Return the share of ``count`` points within each tolerance."""
    return np.array([np.count_nonzero(distance_m <= t / 1000) / count for t in TOLERANCES_MM])


_KINDS = (
    (
        "accuracy",
        "Cloud accuracy",
        f"share of interior pixels (at most {MAX_POINTS} a view, evenly) whose predicted point is within {{t}} mm "
        "of a true point; a missing one is not",
    ),
    (
        "completeness",
        "Cloud completeness",
        f"share of interior pixels (at most {MAX_POINTS} a view, evenly) whose true point is within {{t}} mm "
        "of a predicted point",
    ),
    (
        "f",
        "Cloud F-score",
        "2 a c / (a + c) of accuracy a and completeness c at {t} mm, view by view (Knapitsch et al. 2017)",
    ),
)
"""Key, title and definition of each kind of measure."""


MEASURES: tuple[Measure, ...] = tuple(
    Measure(
        name=f"cloud_{kind}_{t}mm",
        sample=f"cloud_{kind}_{t}mm",
        statistic="mean",
        title=f"{title}, {t} mm",
        unit="%",
        better="higher",
        definition=definition.format(t=t),
    )
    for kind, title, definition in _KINDS
    for t in TOLERANCES_MM
)
"""Point cloud measures in table order."""
