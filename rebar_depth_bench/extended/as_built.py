"""As built against as designed: the deviation of bars from their nominal axes, as measured and as it is.

For each straight bar segment that a view shows, of a bar with a nominal axis, a cylinder is fitted to the
predicted points as for the other measures of inspection. In the middle of what is seen of the segment, the vectors
from the nominal axis to the fitted axis and to the axis as built, both across the nominal axis, are compared.
Frame: the camera's, metres.

The axis as built is the whole polyline, not its straight segments, which leave out the bow of a bar.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.bar_crossings.axis_segments import nearest_points
from rebar_depth_bench.extended.fits import fit_axes, with_misses
from rebar_depth_bench.extended.inspection import JUDGED_NOTE, MISSED_NOTE
from rebar_depth_bench.extended.judged import VisibleSegments
from rebar_depth_bench.extended.measures import Measure, Samples
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.geometry.cameras import transform

OFF_MM = 10.0
"""Deviation above which a bar is off: the tolerance of bar spacing in GB 50204 (from a secondary source)."""

MAX_TURN_DEG = 30.0
"""Largest angle between a segment and the part of its nominal axis that it is compared with, degrees.

It keeps the other arms of a bent bar and its bends apart.
"""

_MM = 1000.0


def as_built_samples(p_m: Float64[ndarray, " n"], designed: DesignedSegments | None) -> Samples:
    """Return the samples of one view; ``MEASURES`` defines what each is.

    ``p_m`` is the predicted planar depth on the pixels of ``SteelTruth`` in metres; values that are not finite and
    > 0 count as missing. Without ``designed_segments`` there are no samples. Which segments are judged depends on
    the ground truth alone.
    """
    if designed is None:
        return {}
    fitted = fit_axes(p_m, designed.shown)
    fitted_m = np.where(fitted.found[:, None], fitted.point_m, np.nan)
    measured_m = _across(fitted_m - designed.nominal_m, designed.direction)
    true_mm, measured_mm, error_mm = (
        np.linalg.norm(vector_m, axis=1) * _MM
        for vector_m in (designed.true_m, measured_m, measured_m - designed.true_m)
    )
    is_off, is_reported = true_mm > OFF_MM, measured_mm > OFF_MM
    return {
        "deviation_judged_mm": with_misses(error_mm),
        "deviation_excess_mm": (measured_mm - true_mm)[fitted.found],
        "deviation_true_mm": true_mm,
        "off_reported": is_reported[is_off].astype(np.float64),
        "off_confirmed": is_off[is_reported].astype(np.float64),
    }


@dataclass(frozen=True, eq=False)
class DesignedSegments:
    """Judged segments of a view: what is seen of them, and a point and the direction of the nominal axis, metres.

    ``true_m`` are the vectors from the nominal axis to the axis as built, across the nominal one.
    """

    shown: VisibleSegments
    nominal_m: Float64[ndarray, "r 3"]
    direction: Float64[ndarray, "r 3"]
    true_m: Float64[ndarray, "r 3"]


def designed_segments(truth: SteelTruth, visible: VisibleSegments) -> DesignedSegments | None:
    """Return the visible segments of bars with a nominal axis; None if there are none."""
    bars = truth.bars
    rows, built, nominal = [], [], []
    for row, bar_id in enumerate(bars.cage.bar_id[visible.segment].tolist()):
        if bar_id not in bars.designed:
            continue
        bar, along = bars.designed[bar_id], visible.frame[row, 2]
        axis_m, nominal_axis_m = (
            transform(truth.cam_from_world, np.array(line_m)) for line_m in (bar.axis_m, bar.nominal_axis_m)
        )
        edge = _nearest_edge(axis_m, visible.middle_m[row], along)
        built_m = visible.middle_m[row] if edge is None else edge[0]
        if nominal_edge := _nearest_edge(nominal_axis_m, built_m, along):
            rows.append(row)
            built.append(built_m)
            nominal.append(nominal_edge)
    if not rows:
        return None
    nominal_m, direction = np.array(nominal).transpose(1, 0, 2)
    return DesignedSegments(
        visible.of(np.array(rows)), nominal_m, direction, _across(np.array(built) - nominal_m, direction)
    )


def _nearest_edge(
    line_m: Float64[ndarray, "n 3"], point_m: Float64[ndarray, " 3"], along: Float64[ndarray, " 3"]
) -> tuple[Float64[ndarray, " 3"], Float64[ndarray, " 3"]] | None:
    """Return the nearest point and the unit direction of the edge of a polyline that is nearest to a point.

    Edges within ``MAX_TURN_DEG`` of ``along`` count; None without any.
    """
    step_m = np.diff(line_m, axis=0)
    length_m = np.linalg.norm(step_m, axis=1, keepdims=True)
    direction = step_m / np.where(length_m > 0, length_m, 1.0)
    nearest_m, _, distance_m = nearest_points(point_m, line_m[:-1], step_m)
    aligned = np.abs(direction @ along) >= np.cos(np.deg2rad(MAX_TURN_DEG))
    if not aligned.any():
        return None
    edge = int(np.argmin(np.where(aligned, distance_m, np.inf)))
    return nearest_m[edge], direction[edge]


def _across(vector_m: Float64[ndarray, "r 3"], direction: Float64[ndarray, "r 3"]) -> Float64[ndarray, "r 3"]:
    """Return the parts of vectors across the directions."""
    return np.asarray(vector_m - np.einsum("ri,ri->r", vector_m, direction)[:, None] * direction)


_DEVIATION = (
    "vector from the nominal axis to the axis of the bar, across the nominal one, in the middle of what is seen "
    "of a run; bars with a nominal axis"
)
_ERROR = "length of the difference of the deviations by the fitted axis and by the axis as built"

MEASURES = (
    Measure(
        "deviation_median_mm", "deviation from the design: median error", "mm", "lower",
        f"Median {_ERROR}. Deviation: {_DEVIATION}. {MISSED_NOTE} {JUDGED_NOTE}", "deviation_judged_mm", "median",
    ),
    Measure(
        "deviation_p95_mm", "deviation from the design: p95 error", "mm", "lower",
        f"95th percentile of the {_ERROR}. {MISSED_NOTE}", "deviation_judged_mm", "p95",
    ),
    Measure(
        "deviation_bias_mm", "deviation from the design: bias", "mm", "",
        "Mean length of the deviation by the fitted axis minus that by the axis as built, over found runs.",
        "deviation_excess_mm",
    ),
    Measure(
        "deviation_true_median_mm", "deviation as built: median", "mm", "",
        "Median length of the deviation by the axis as built, from the ground truth alone: the error of a report "
        "that all bars are as designed.", "deviation_true_mm", "median",
    ),
    Measure(
        "deviation_true_p95_mm", "deviation as built: p95", "mm", "",
        "95th percentile of the length of the deviation by the axis as built, from the ground truth alone.",
        "deviation_true_mm", "p95",
    ),
    Measure(
        "off_recall", f"bars off by more than {OFF_MM:g} mm: recall", "%", "higher",
        f"Share of the runs as built more than {OFF_MM:g} mm off the nominal axis whose fitted axis is, too; what "
        "was not found counts as a failure. The samples are the runs that are off.", "off_reported",
    ),
    Measure(
        "off_precision", f"bars off by more than {OFF_MM:g} mm: precision", "%", "",
        f"Share of the runs with a fitted axis more than {OFF_MM:g} mm off the nominal one that are as built, "
        "too. The samples are the runs that are reported as off.", "off_confirmed",
    ),
)  # fmt: skip
"""Measures of deviations from the design in table order."""
