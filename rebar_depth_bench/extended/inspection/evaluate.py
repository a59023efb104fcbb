"""Inspection, bar by bar: is each bar found, and how far off are its place, its spacing and its diameter?

Each straight run of a bar that a view shows gets a cylinder of the nominal diameter, fitted to the predicted
points of its interior pixels. What is compared are axes: fitted against true. Frame: the camera's, metres.
Whether a run or a pair is judged is decided by the ground truth alone, so what a submission leaves out fails.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from rebar_depth_bench.extended.inspection.cylinder_fit import CylinderFits, fit_cylinders
from rebar_depth_bench.extended.inspection.measures import (
    INSPECTION_MEASURES,
    MIN_PREDICTED,
    MISS_MM,
    SIDE_BY_SIDE,
)
from rebar_depth_bench.extended.inspection.segments import CageTruth
from rebar_depth_bench.extended.inspection.tolerances import PROFILES, ErrorKind, pass_sample
from rebar_depth_bench.extended.inspection.visible_segments import SeenRuns, seen_runs
from rebar_depth_bench.extended.measures import Samples
from rebar_depth_bench.extended.steel_truth import SteelTruth

FARTHEST_M = 1e6
"""Predictions beyond are taken as this far: no square of them overflows."""

_MM = 1000.0

MEASURES = INSPECTION_MEASURES


@dataclass(frozen=True, eq=False)
class _Fitted:
    """What was made of each seen run: axis as point and direction (camera frame), offset from the true axis."""

    found: Bool[ndarray, " r"]
    point_m: Float64[ndarray, "r 3"]
    direction: Float64[ndarray, "r 3"]
    offset_m: Float64[ndarray, " r"]
    tilt_deg: Float64[ndarray, " r"]


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Neighbours seen side by side: positions among the seen runs, and the plane that cuts both axes."""

    first: Int64[ndarray, " m"]
    second: Int64[ndarray, " m"]
    middle_m: Float64[ndarray, "m 3"]
    normal: Float64[ndarray, "m 3"]


def inspection_samples(
    p_m: Float64[ndarray, " n"], truth: SteelTruth, cage: CageTruth, seen: SeenRuns | None = None
) -> Samples:
    """Return what inspection finds in one view's prediction; ``MEASURES`` says what each sample is.

    ``p_m`` are predicted planar depths on ``truth.index`` in metres; a value that is not finite and > 0 is no
    prediction. ``seen`` saves working out ``seen_runs(truth, cage)`` again. Lengths of the samples depend on the
    truth alone, but for those of found bars only (``..._error_mm``, ``axis_offset_mm``, ``axis_tilt_deg``). Raises
    ``ValueError`` for another length of ``p_m``.
    """
    if p_m.shape != truth.index.shape:
        raise ValueError(f"p_m has shape {p_m.shape}, expected {truth.index.shape} as truth.index has")
    seen = seen or seen_runs(truth, cage)
    points_m, predicted = _predicted_points_m(p_m, seen)
    start_m = _start_m(points_m, predicted, seen)
    fits = fit_cylinders(points_m, predicted, start_m, seen.half_m, seen.diameter_m / 2, seen.wide)
    fitted = _against_truth(fits, predicted, seen)
    pairs = _seen_pairs(seen, cage)
    spacing_m, layer_m = _pair_errors_m(pairs, seen, fitted)
    cover_m = (fitted.point_m - seen.middle_m)[:, 2]
    errors_mm: Mapping[ErrorKind, Float64[ndarray, " n"]] = {
        "spacing": spacing_m * _MM,
        "layer": layer_m * _MM,
        "cover": np.where(fitted.found, cover_m, np.nan) * _MM,
    }
    grown_m = np.where(fitted.found, fits.diameter_m - seen.diameter_m, np.nan)
    return {
        "bar_found": fitted.found.astype(np.float64),
        "axis_offset_mm": fitted.offset_m[fitted.found] * _MM,
        "axis_offset_judged_mm": _judged_mm(np.where(fitted.found, fitted.offset_m * _MM, np.nan)),
        "axis_tilt_deg": fitted.tilt_deg[fitted.found],
        **_error_samples(errors_mm),
        **_error_samples({"diameter": grown_m[seen.wide] * _MM}),
        **_pass_samples(errors_mm),
    }


def _predicted_points_m(
    p_m: Float64[ndarray, " n"], seen: SeenRuns
) -> tuple[Float64[ndarray, "r k 3"], Bool[ndarray, "r k"]]:
    """Return the predicted points of each seen run in its own frame, and which of them there are.

    How far along the axis a point is, is told by its pixel, not by its depth: where a bar runs away from the
    camera, noise in depth spreads points along it and away from it at once, and would turn the axis.
    """
    depth_m = p_m.take(seen.pixels)
    with np.errstate(invalid="ignore"):
        predicted = seen.used & np.isfinite(depth_m) & (depth_m > 0)
        known_m = np.where(predicted, np.minimum(depth_m, FARTHEST_M), 0.0)
    points_m = seen.local_points_m(known_m)
    points_m[..., 2] = seen.truth_m[..., 2]
    return points_m, predicted


def _start_m(
    points_m: Float64[ndarray, "r k 3"], predicted: Bool[ndarray, "r k"], seen: SeenRuns
) -> Float64[ndarray, "r 2"]:
    """Return where each fit starts: the true axis moved by the median way from true to predicted points."""
    moved_m = np.where(predicted[..., None], (points_m - seen.truth_m)[..., :2], np.inf)
    ordered_m = np.sort(moved_m, axis=1)
    count = predicted.sum(axis=1)
    low, high = np.maximum(count - 1, 0) // 2, np.minimum(count // 2, np.maximum(count - 1, 0))
    row = np.arange(len(count))
    median_m = (ordered_m[row, low] + ordered_m[row, high]) / 2
    return np.where((count > 0)[:, None], median_m, 0.0)


def _against_truth(fits: CylinderFits, predicted: Bool[ndarray, "r k"], seen: SeenRuns) -> _Fitted:
    """Return the fitted axes in the camera's frame and how far they are from the true ones."""
    with np.errstate(over="ignore", invalid="ignore"):
        steepness = (fits.slope**2).sum(axis=1)
        lean_m = (fits.offset_m * fits.slope).sum(axis=1)
        offset_m = np.sqrt(np.maximum((fits.offset_m**2).sum(axis=1) - lean_m**2 / (1 + steepness), 0.0))
        enough = predicted.sum(axis=1) >= MIN_PREDICTED * seen.used.sum(axis=1)
        to_end_m = fits.slope * seen.half_m[:, None]
        ends_m = (np.linalg.norm(fits.offset_m + side * to_end_m, axis=1) for side in (-1, 1))
        farthest_m = np.maximum(offset_m, np.maximum(*ends_m))
        found = enough & fits.converged & (farthest_m < seen.reach_m)
        local = np.column_stack([fits.slope, np.ones(len(fits.slope))]) / np.sqrt(1 + steepness)[:, None]
        return _Fitted(
            found=found,
            point_m=seen.middle_m + np.einsum("rc,rci->ri", fits.offset_m, seen.frame[:, :2]),
            direction=np.einsum("rc,rci->ri", local, seen.frame),
            offset_m=offset_m,
            tilt_deg=np.rad2deg(np.arctan(np.sqrt(steepness))),
        )


def _seen_pairs(seen: SeenRuns, cage: CageTruth) -> _Pairs:
    """Return the neighbours of which both are seen, side by side."""
    place = np.full(len(cage.runs), -1)
    place[seen.run] = np.arange(len(seen.run))
    first, second = place[cage.neighbours].T
    both = (first >= 0) & (second >= 0)
    first, second = first[both], second[both]
    normal = seen.frame[first, 2]
    between_m = np.einsum("mi,mi->m", seen.middle_m[second] - seen.middle_m[first], normal)
    low_m = np.maximum(-seen.half_m[first], between_m - seen.half_m[second])
    high_m = np.minimum(seen.half_m[first], between_m + seen.half_m[second])
    beside = high_m - low_m >= SIDE_BY_SIDE * np.maximum(seen.diameter_m[first], seen.diameter_m[second])
    middle_m = seen.middle_m[first] + ((low_m + high_m) / 2)[:, None] * normal
    return _Pairs(first[beside], second[beside], middle_m[beside], normal[beside])


def _pair_errors_m(
    pairs: _Pairs, seen: SeenRuns, fitted: _Fitted
) -> tuple[Float64[ndarray, " s"], Float64[ndarray, " l"]]:
    """Return the errors of separation of pairs across the line of sight, and of pairs along the optical axis.

    Both axes are cut by the plane at right angles to the first one in the middle of what is seen of both; what is
    compared is the way from cut to cut along the true one. NaN where either is not found.
    """
    true_m = _apart_m(pairs, seen.middle_m, seen.frame[:, 2])
    distance_m = np.linalg.norm(true_m, axis=1)
    toward = true_m / distance_m[:, None]
    with np.errstate(all="ignore"):
        found_m = np.einsum("mi,mi->m", _apart_m(pairs, fitted.point_m, fitted.direction), toward)
        both = fitted.found[pairs.first] & fitted.found[pairs.second]
        error_m = np.where(both, found_m - distance_m, np.nan)
    is_layer = np.abs(toward[:, 2]) >= np.sqrt(0.5)
    return error_m[~is_layer], error_m[is_layer]


def _apart_m(
    pairs: _Pairs, point_m: Float64[ndarray, "r 3"], direction: Float64[ndarray, "r 3"]
) -> Float64[ndarray, "m 3"]:
    """Return the way from the first line's cut with each pair's plane to the second line's."""
    cuts_m = []
    for run in (pairs.first, pairs.second):
        to_plane_m = np.einsum("mi,mi->m", pairs.middle_m - point_m[run], pairs.normal)
        rate = np.einsum("mi,mi->m", direction[run], pairs.normal)
        cuts_m.append(point_m[run] + (to_plane_m / rate)[:, None] * direction[run])
    return np.asarray(cuts_m[1] - cuts_m[0])


def _judged_mm(error_mm: Float64[ndarray, " n"]) -> Float64[ndarray, " n"]:
    """Return absolute errors, ``MISS_MM`` for what was not found and for any larger one."""
    return np.where(np.isnan(error_mm), MISS_MM, np.minimum(np.abs(error_mm), MISS_MM))


def _error_samples(
    errors_mm: Mapping[ErrorKind, Float64[ndarray, " n"]] | Mapping[str, Float64[ndarray, " n"]],
) -> dict[str, Float64[ndarray, " n"]]:
    """Return for each kind the signed errors of what was found, and the absolute ones of all that was judged."""
    samples = {}
    for kind, error_mm in errors_mm.items():
        samples[f"{kind}_error_mm"] = error_mm[~np.isnan(error_mm)]
        samples[f"{kind}_judged_mm"] = _judged_mm(error_mm)
    return samples


def _pass_samples(errors_mm: Mapping[ErrorKind, Float64[ndarray, " n"]]) -> dict[str, Float64[ndarray, " n"]]:
    """Return 1 for each error within a tolerance, 0 for the others and for what was not found."""
    return {
        pass_sample(tolerance): (_judged_mm(errors_mm[tolerance.kind]) <= tolerance.limit_mm).astype(np.float64)
        for profile in PROFILES
        for tolerance in profile.tolerances
    }
