"""Crossing measures: names, units and definitions of the table entries."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import pairwise

from rebar_depth_bench.extended.inspection.measures import MISS_MM
from rebar_depth_bench.extended.measures import Measure, Statistic
from rebar_depth_bench.extended.profiles import DISTANCE_EDGES_M, WIDTH_EDGES_PX

WITHIN_MM = (2, 5, 10)
"""Limits of the share of tie points within a distance, mm."""

MISS_DEG = 90.0
"""Error of angle and normal of a crossing that was not located, degrees: the largest one of undirected lines."""

CROSSING_EDGES_M = (0.1, 0.15, *DISTANCE_EDGES_M)
ANGLE_EDGES_DEG = (20.0, 30.0, 45.0, 60.0, 75.0, 90.0)
GAP_EDGES_MM = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)

BINS: Mapping[str, tuple[float, ...]] = {
    "m": CROSSING_EDGES_M,
    "deg": ANGLE_EDGES_DEG,
    "mm": GAP_EDGES_MM,
    "px": WIDTH_EDGES_PX,
}
"""Bin edges by unit: true depth of the tie point, angle, gap, and width of the thinner bar in the image.

A bin includes its lower edge, and the last one its upper edge. Negative gaps have a bin of their own.
"""

NEGATIVE_GAP = "negative-gap"
"""Name of the bin of negative gaps."""

DISTANCE_BINS = ("within_2mm", "within_5mm")
CROSSING_BINS = ("located", "within_5mm")
"""Shares of the bins of distance, and of the other bins."""

_JUDGED = (
    "crossings whose tie point shows one of the bars, both straight there and with 30 single-bar pixels or more"
)
_MISSED = f"What is not located counts as {MISS_MM:g} mm."
_MISSED_DEG = f"What is not located counts as {MISS_DEG:g} degrees."
_FITTED = "closest points of the cylinders fitted to both bars within 6 diameters of the crossing"


def _judged_pair(name: str, sample: str, title: str, unit: str, definition: str, note: str) -> tuple[Measure, ...]:
    """Return median and 95th percentile of an absolute error over all judged crossings."""
    suffix = "mm" if unit == "mm" else "deg"
    shown = unit if unit == "mm" else ""
    heads: dict[Statistic, tuple[str, str]] = {"median": ("median", "Median"), "p95": ("p95", "95th percentile")}
    in_unit = "" if unit == "mm" else ", degrees"
    return tuple(
        Measure(
            f"{name}_{statistic}_{suffix}", sample, statistic, f"{title}: {short}{in_unit}", shown, "lower",
            f"{text} of the {definition}. {note}",
        )
        for statistic, (short, text) in heads.items()
    )  # fmt: skip


def _bias(name: str, sample: str, title: str, definition: str) -> Measure:
    return Measure(name, sample, "mean", title, "mm", "", f"Mean over located crossings: {definition}.")


_TIE = f"distance of the fitted tie point from the true one: {_FITTED}"

MAIN_MEASURES: tuple[Measure, ...] = (
    Measure(
        "crossings_judged", "crossings_judged", "mean", "crossings judged", "%", "",
        f"Mean over views of the share of the scene's crossings that are judged, by the truth alone: {_JUDGED}.",
    ),
    Measure(
        "crossings_located", "crossing_located", "mean", "crossings located", "%", "higher",
        "Share of judged crossings whose two fitted cylinders pass the rules of bars_found.",
    ),
    *_judged_pair("tie", "tie_judged_mm", "tie point", "mm", _TIE, _MISSED),
    *_judged_pair(
        "tie_along", "tie_along_judged_mm", "tie point along the optical axis", "mm",
        "absolute error of the tie point along the optical axis", _MISSED,
    ),
    *_judged_pair(
        "tie_across", "tie_across_judged_mm", "tie point across the optical axis", "mm",
        "error of the tie point across the optical axis", _MISSED,
    ),
    _bias(
        "tie_along_bias_mm", "tie_along_error_mm", "tie point along the optical axis: bias",
        "fitted minus true place along the optical axis; more is further from the camera",
    ),
    _bias(
        "tie_right_bias_mm", "tie_right_error_mm", "tie point to the right: bias",
        "fitted minus true place along the camera's x axis, to the right of the image",
    ),
    _bias(
        "tie_down_bias_mm", "tie_down_error_mm", "tie point downwards: bias",
        "fitted minus true place along the camera's y axis, downwards in the image",
    ),
    _bias(
        "crossing_gap_bias_mm", "crossing_gap_error_mm", "gap of the surfaces: bias",
        "fitted minus true gap between the surfaces along the normal",
    ),
    *_judged_pair(
        "crossing_gap", "crossing_gap_judged_mm", "gap of the surfaces", "mm",
        "absolute error of the gap between the surfaces along the normal", _MISSED,
    ),
    *_judged_pair(
        "crossing_angle", "crossing_angle_judged_deg", "angle of the bars", "degrees",
        "absolute error of the angle between the axes", _MISSED_DEG,
    ),
    *_judged_pair(
        "crossing_normal", "crossing_normal_judged_deg", "normal", "degrees",
        "undirected angle between fitted and true normal of both axes", _MISSED_DEG,
    ),
    *(
        Measure(
            f"tie_within_{limit}mm", f"tie_within_{limit}mm", "mean", f"tie point within {limit} mm", "%",
            "higher",
            f"Share of judged crossings whose tie point is within {limit} mm; what is not located fails",
        )
        for limit in WITHIN_MM
    ),
)  # fmt: skip
"""Measures of all judged crossings, in table order."""

_BIN_TEXTS: Mapping[str, tuple[str, str]] = {
    "m": ("At {} m", "at a true depth of {} m"),
    "deg": ("Angle of {} degrees", "at an angle of {} degrees"),
    "mm": ("Gap of {} mm", "with a gap of {} mm"),
    "px": ("Bars of {} px", "whose thinner bar is {} px wide in the image"),
}
_NEGATIVE_TEXTS = ("Intersecting bars", "with a negative gap")
_SHARE_TEXTS: Mapping[str, tuple[str, str]] = {
    "located": ("located", "that are located"),
    **{
        f"within_{limit}mm": (
            f"within {limit} mm",
            f"whose tie point is within {limit} mm; what is not located fails",
        )
        for limit in WITHIN_MM
    },
}


def _binned_measures() -> Iterator[Measure]:
    """Yield the shares of each bin; shares of one kind are together."""
    for unit, edges in BINS.items():
        bins = [
            (f"{low:g}-{high:g}{unit}", *_BIN_TEXTS[unit], f"{low:g}-{high:g}") for low, high in pairwise(edges)
        ]
        if unit == "mm":
            bins.insert(0, (NEGATIVE_GAP, *_NEGATIVE_TEXTS, ""))
        for share in DISTANCE_BINS if unit == "m" else CROSSING_BINS:
            head, text = _SHARE_TEXTS[share]
            for name, title, where, step in bins:
                key = f"tie_{share}_at_{name}"
                definition = f"Share of judged crossings {where.format(step)} {text}"
                yield Measure(key, key, "mean", f"{title.format(step)}: {head}", "%", "higher", definition)


BINNED_MEASURES: tuple[Measure, ...] = tuple(_binned_measures())
"""Shares of judged crossings by distance, angle, gap and width, in table order."""
