"""Measures of crossings: tie points, layers and angles of cylinders that are fitted to both bars.

They are statistics of the samples of native depth (``frames``). What is judged depends on the ground truth alone,
so a missing prediction counts as a failure.
"""

from __future__ import annotations

import numpy as np

from rebar_depth_bench.extended.fits import MISS_MM, with_misses
from rebar_depth_bench.extended.frames import CrossingSamples
from rebar_depth_bench.extended.measures import Measure, Samples

WITHIN_MM = (2, 5)
"""Limits of the share of tie points within a distance, mm."""

MISS_DEG = 90.0
"""Error of the angle of a crossing that was not located, degrees: the largest one of undirected lines."""

_MISSED = f"What is not located counts as {MISS_MM:g} mm."
_LAYER = "distance of the two axes along the normal of the crossing"

MEASURES = (
    Measure(
        "crossings_located", "crossings located", "%", "higher",
        "Share of judged crossings whose two fitted cylinders pass the rules of bars_found. Judged are crossings "
        "whose tie point's pixel shows one of the bars near it, both straight there, with 30 single-bar pixels.",
        "crossing_located",
    ),
    Measure(
        "tie_median_mm", "tie point: median", "mm", "lower",
        "Median distance of the fitted tie point from the true one: closest points of the cylinders fitted to "
        f"both bars within 6 diameters of the crossing. {_MISSED}", "tie_judged_mm", "median",
    ),
    Measure(
        "tie_p95_mm", "tie point: p95", "mm", "lower",
        f"95th percentile distance of the fitted tie point from the true one. {_MISSED}", "tie_judged_mm", "p95",
    ),
    Measure(
        "tie_along_bias_mm", "tie point along the optical axis: bias", "mm", "",
        "Mean over located crossings: fitted minus true place along the optical axis; more is further from the "
        "camera.", "tie_along_error_mm",
    ),
    Measure(
        "tie_along_p95_mm", "tie point along the optical axis: p95", "mm", "lower",
        f"95th percentile of the absolute error of the tie point along the optical axis. {_MISSED}",
        "tie_along_judged_mm", "p95",
    ),
    Measure(
        "tie_across_p95_mm", "tie point across the optical axis: p95", "mm", "lower",
        f"95th percentile of the error of the tie point across the optical axis. {_MISSED}",
        "tie_across_judged_mm", "p95",
    ),
    Measure(
        "layer_bias_mm", "distance of layers: bias", "mm", "",
        f"Mean over located crossings: fitted minus true {_LAYER}.", "layer_error_mm",
    ),
    Measure(
        "layer_p95_mm", "distance of layers: p95 error", "mm", "lower",
        f"95th percentile of the absolute error of the {_LAYER}. {_MISSED}", "layer_judged_mm", "p95",
    ),
    Measure(
        "crossing_angle_p95_deg", "angle of the bars: p95 error, degrees", "", "lower",
        "95th percentile of the absolute error of the angle between the axes. What is not located counts as "
        f"{MISS_DEG:g} degrees.", "crossing_angle_judged_deg", "p95",
    ),
    *(
        Measure(
            f"tie_within_{limit}mm", f"tie point within {limit} mm", "%", "higher",
            f"Share of judged crossings whose tie point is within {limit} mm; what is not located fails.",
        )
        for limit in WITHIN_MM
    ),
)  # fmt: skip
"""Measures of crossings in table order."""


def crossing_samples(crossings: CrossingSamples) -> Samples:
    """Return the samples of ``MEASURES``, which define what each is.

    ``..._error_mm`` are signed errors of located crossings, ``..._judged_...`` absolute errors of all crossings.
    """
    found, layer_mm = crossings.found, crossings.layer_mm - crossings.true_layer_mm
    return {
        "crossing_located": found.astype(np.float64),
        "tie_judged_mm": with_misses(crossings.tie_error_mm),
        "tie_along_judged_mm": with_misses(crossings.tie_along_mm),
        "tie_across_judged_mm": with_misses(crossings.tie_across_mm),
        "layer_judged_mm": with_misses(layer_mm),
        "crossing_angle_judged_deg": with_misses(crossings.angle_deg - crossings.true_angle_deg, MISS_DEG),
        "tie_along_error_mm": crossings.tie_along_mm[found],
        "layer_error_mm": layer_mm[found],
        **{f"tie_within_{limit}mm": (crossings.tie_error_mm <= limit).astype(np.float64) for limit in WITHIN_MM},
    }
