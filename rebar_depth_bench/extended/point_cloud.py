"""Completeness and accuracy of the steel as a point cloud, at 1, 2, 5, 10 and 20 mm.

After Knapitsch et al., "Tanks and Temples", ACM TOG 2017 (precision, recall and F-score of a reconstruction) and
Seitz et al., CVPR 2006 (accuracy, completeness), for the points of one view in the camera's frame: the interior
pixels' rays at true and at predicted depth, ``x_cam = depth_m * (rays[:, 0], rays[:, 1], 1)``, with no alignment
beyond what the caller did to the depth. Both clouds are of the same pixels, at most ``MAX_POINTS``, so that
the truth is perfect:

    accuracy[t]     = share of the pixels whose predicted point is within t of a true point
    completeness[t] = share of the pixels whose true point is within t of a predicted point
    F[t]            = 2 accuracy completeness / (accuracy + completeness), 0 where both are 0

A missing prediction is no point for completeness and a failure for accuracy: taking predictions away raises
neither. Thinner clouds have neighbours farther apart and so lower shares at small t: ``MAX_POINTS`` is part of the
definition. Far away, pixels lie wider apart than t (17 mm at 12 m and 700 px): a point's match is then its own
pixel's or none.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray
from scipy.spatial import cKDTree

from rebar_depth_bench.extended.measures import Measure, Samples, thinned
from rebar_depth_bench.extended.steel_truth import SteelTruth
from rebar_depth_bench.scoring.metrics import is_prediction

TOLERANCES_MM = (1, 2, 5, 10, 20)
MAX_POINTS = 4000

_REACH_M = 1.001 * TOLERANCES_MM[-1] / 1000  # a tree finds what is nearer than this, not what is as near


@dataclass(frozen=True, eq=False)
class TrueCloud:
    """A view's true points, camera frame, metres, at ``position`` in ``SteelTruth.index``, and their k-d tree.

    ``rays`` are ``(x/z, y/z, 1)``.
    """

    position: Int64[ndarray, " m"]
    rays: Float64[ndarray, "m 3"]
    points_m: Float64[ndarray, "m 3"]
    tree: Any


def true_cloud(truth: SteelTruth) -> TrueCloud:
    """Return the thinned true points of a view's interior; the same for every prediction of the view."""
    position = thinned(np.flatnonzero(truth.interior), MAX_POINTS)
    rays = np.concatenate([truth.rays[position], np.ones((len(position), 1))], axis=1)
    points_m = rays * truth.depth_m[position, None].astype(np.float64)
    return TrueCloud(position, rays, points_m, _tree(points_m))


def cloud_samples(p_m: Float64[ndarray, " n"], truth: SteelTruth, cloud: TrueCloud | None = None) -> Samples:
    """Return a view's cloud scores; ``p_m`` is planar depth on ``truth.index``, metres, NaN for none.

    One value 0 to 1 each of ``cloud_accuracy_<t>mm``, ``cloud_completeness_<t>mm`` and ``cloud_f_<t>mm``; none
    where the view has no interior pixel. ``cloud`` saves building ``true_cloud(truth)`` again.
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
    """Return distances of predicted points to the true cloud and of true points to the predicted one, metres.

    ``p_m`` belongs to the pixels. Infinite, or left out of the first, is what no tolerance reaches. Where a
    pixel's own two points are within the smallest tolerance, their distance stands for the nearest one's: both
    count at every tolerance.
    """
    z_m = cloud.points_m[:, 2]
    near = is_prediction(p_m)  # two points are no nearer to each other than their planar depths
    near &= (p_m > z_m.min() - _REACH_M) & (p_m < z_m.max() + _REACH_M)
    depth_m = np.where(near, p_m, np.inf)
    own_m = np.abs(depth_m - z_m) * np.sqrt(np.einsum("ij,ij->i", cloud.rays, cloud.rays))
    unmatched = own_m > TOLERANCES_MM[0] / 1000
    points_m = cloud.rays[near] * depth_m[near, None]
    accuracy_m = _nearest_m(cloud.tree, points_m, own_m[near], unmatched[near])
    if not unmatched.any():
        return accuracy_m, own_m
    return accuracy_m, _nearest_m(_tree(points_m), cloud.points_m, own_m, unmatched)


def _nearest_m(
    tree: Any, points_m: Float64[ndarray, "m 3"], own_m: Float64[ndarray, " m"], look_up: Bool[ndarray, " m"]
) -> Float64[ndarray, " m"]:
    """Return each point's distance to the tree's nearest, infinite out of reach; ``own_m`` where not looked up."""
    distance_m = own_m.copy()
    if tree.n and look_up.any():
        distance_m[look_up] = tree.query(points_m[look_up], distance_upper_bound=_REACH_M)[0]
    return distance_m


def _tree(points_m: Float64[ndarray, "m 3"]) -> Any:
    """Return a k-d tree that is quick to build: it answers one set of questions."""
    return cKDTree(points_m, balanced_tree=False, compact_nodes=False)


def _shares_within(distance_m: Float64[ndarray, " m"], count: int) -> Float64[ndarray, " t"]:
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
