"""Per-bar inspection: detection of each bar and the errors of its position, spacing and diameter.

For each straight bar segment that a view shows, a cylinder of the nominal diameter is fitted to the predicted
points of its interior pixels, and the fitted axis is compared with the true one. Frame: the camera's, metres.
Whether a segment or a pair is judged depends on the ground truth alone, so a missing prediction counts as a
failure.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from rebar_depth_bench.extended.inspection.axis_fits import FittedAxes, fit_axes, with_misses
from rebar_depth_bench.extended.inspection.measures import MIN_VISIBLE_OVERLAP_DIAMETERS
from rebar_depth_bench.extended.inspection.segments import CageTruth
from rebar_depth_bench.extended.inspection.tolerances import TOLERANCES, ErrorKind, pass_sample
from rebar_depth_bench.extended.inspection.visible_segments import VisibleSegments, visible_segments
from rebar_depth_bench.extended.measures import Samples
from rebar_depth_bench.extended.steel_truth import SteelTruth

_MM = 1000.0


@dataclass(frozen=True, eq=False)
class _SegmentPairs:
    """Neighbouring segments that are both visible, side by side.

    ``first`` and ``second`` are positions among the visible segments. ``middle_m`` and ``normal`` define the
    plane that is intersected with both axes.
    """

    first: Int64[ndarray, " m"]
    second: Int64[ndarray, " m"]
    middle_m: Float64[ndarray, "m 3"]
    normal: Float64[ndarray, "m 3"]


def inspection_samples(
    p_m: Float64[ndarray, " n"], truth: SteelTruth, cage: CageTruth, visible: VisibleSegments | None = None
) -> Samples:
    """Return the inspection samples of one view; ``INSPECTION_MEASURES`` defines what each is.

    ``p_m`` is the predicted planar depth on ``truth.index`` in metres; values that are not finite and > 0 count
    as missing. ``visible`` is ``visible_segments(truth, cage)``, if already computed. The lengths of the samples
    depend on the ground truth alone, except for those of found bars (``..._error_mm``, ``axis_offset_mm``,
    ``axis_tilt_deg``). Raises ``ValueError`` if the length of ``p_m`` differs from that of ``truth.index``.
    """
    if p_m.shape != truth.index.shape:
        raise ValueError(f"p_m has shape {p_m.shape}, expected {truth.index.shape} as truth.index has")
    visible = visible or visible_segments(truth, cage)
    fitted = fit_axes(p_m, visible, visible.can_fit_diameter)
    pairs = _visible_pairs(visible, cage)
    spacing_m, layer_m = _pair_errors_m(pairs, visible, fitted)
    cover_m = (fitted.point_m - visible.middle_m)[:, 2]
    errors_mm: Mapping[ErrorKind, Float64[ndarray, " n"]] = {
        "spacing": spacing_m * _MM,
        "layer": layer_m * _MM,
        "cover": np.where(fitted.found, cover_m, np.nan) * _MM,
    }
    diameter_error_m = np.where(fitted.found, fitted.diameter_m - visible.diameter_m, np.nan)
    return {
        "bar_found": fitted.found.astype(np.float64),
        "axis_offset_mm": fitted.offset_m[fitted.found] * _MM,
        "axis_offset_judged_mm": with_misses(np.where(fitted.found, fitted.offset_m * _MM, np.nan)),
        "axis_tilt_deg": fitted.tilt_deg[fitted.found],
        **_error_samples(errors_mm),
        **_error_samples({"diameter": diameter_error_m[visible.can_fit_diameter] * _MM}),
        **_pass_samples(errors_mm),
    }


def _visible_pairs(visible: VisibleSegments, cage: CageTruth) -> _SegmentPairs:
    """Return the neighbour pairs whose segments are both visible and overlap along the first one's axis."""
    position = np.full(len(cage.segments), -1)
    position[visible.segment] = np.arange(len(visible.segment))
    first, second = position[cage.neighbours].T
    both = (first >= 0) & (second >= 0)
    first, second = first[both], second[both]
    normal = visible.frame[first, 2]
    between_m = np.einsum("mi,mi->m", visible.middle_m[second] - visible.middle_m[first], normal)
    low_m = np.maximum(-visible.half_m[first], between_m - visible.half_m[second])
    high_m = np.minimum(visible.half_m[first], between_m + visible.half_m[second])
    overlapping = high_m - low_m >= MIN_VISIBLE_OVERLAP_DIAMETERS * np.maximum(
        visible.diameter_m[first], visible.diameter_m[second]
    )
    middle_m = visible.middle_m[first] + ((low_m + high_m) / 2)[:, None] * normal
    return _SegmentPairs(first[overlapping], second[overlapping], middle_m[overlapping], normal[overlapping])


def _pair_errors_m(
    pairs: _SegmentPairs, visible: VisibleSegments, fitted: FittedAxes
) -> tuple[Float64[ndarray, " s"], Float64[ndarray, " l"]]:
    """Return the separation errors of pairs across the line of sight, and of pairs along the optical axis.

    Both axes are intersected with the plane perpendicular to the first one in the middle of the part where both
    are visible. The error is the fitted separation of the two intersections, projected on the true direction
    between them, minus the true one. NaN where either segment was not found.
    """
    true_m = _separation_m(pairs, visible.middle_m, visible.frame[:, 2])
    distance_m = np.linalg.norm(true_m, axis=1)
    true_direction = true_m / distance_m[:, None]
    with np.errstate(all="ignore"):
        fitted_m = np.einsum("mi,mi->m", _separation_m(pairs, fitted.point_m, fitted.direction), true_direction)
        both = fitted.found[pairs.first] & fitted.found[pairs.second]
        error_m = np.where(both, fitted_m - distance_m, np.nan)
    is_layer = np.abs(true_direction[:, 2]) >= np.sqrt(0.5)
    return error_m[~is_layer], error_m[is_layer]


def _separation_m(
    pairs: _SegmentPairs, point_m: Float64[ndarray, "r 3"], direction: Float64[ndarray, "r 3"]
) -> Float64[ndarray, "m 3"]:
    """Return the vector from the first line's intersection with each pair's plane to the second line's."""
    intersections_m = []
    for segment in (pairs.first, pairs.second):
        to_plane_m = np.einsum("mi,mi->m", pairs.middle_m - point_m[segment], pairs.normal)
        rate = np.einsum("mi,mi->m", direction[segment], pairs.normal)
        intersections_m.append(point_m[segment] + (to_plane_m / rate)[:, None] * direction[segment])
    return np.asarray(intersections_m[1] - intersections_m[0])


def _error_samples(
    errors_mm: Mapping[ErrorKind, Float64[ndarray, " n"]] | Mapping[str, Float64[ndarray, " n"]],
) -> dict[str, Float64[ndarray, " n"]]:
    """Return for each kind the signed errors of what was found, and the absolute errors of all that was judged."""
    samples = {}
    for kind, error_mm in errors_mm.items():
        samples[f"{kind}_error_mm"] = error_mm[~np.isnan(error_mm)]
        samples[f"{kind}_judged_mm"] = with_misses(error_mm)
    return samples


def _pass_samples(errors_mm: Mapping[ErrorKind, Float64[ndarray, " n"]]) -> dict[str, Float64[ndarray, " n"]]:
    """Return for each tolerance 1 for errors within it, 0 for larger ones and for what was not found."""
    return {
        pass_sample(tolerance): (with_misses(errors_mm[tolerance.kind]) <= tolerance.limit_mm).astype(np.float64)
        for _, tolerance in TOLERANCES
    }
