"""Crossing measures of a view: cylinders fitted to both bars of each judged crossing, and their tie points.

At each crossing, cylinders of the nominal diameters are fitted to the predicted depth of the sampled pixels of
both bars, as the inspection does for whole runs. Their closest points give tie point, gap, angle and normal.
Frame: the camera's, metres. What is judged depends on the ground truth alone, so a missing prediction counts as
a failure.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from rebar_depth_bench.bar_crossings.definition import TiePoints, tie_points
from rebar_depth_bench.extended.axes import SceneCrossings
from rebar_depth_bench.extended.fits import MISS_MM, FittedAxes, fit_axes, with_misses
from rebar_depth_bench.extended.judged import AxisLines, VisibleSegments, visible_parts
from rebar_depth_bench.extended.measures import Measure, Samples, Statistic
from rebar_depth_bench.extended.profiles import DISTANCE_EDGES_M, WIDTH_EDGES_PX
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.geometry.cameras import transform

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


_MM = 1000.0


@dataclass(frozen=True, eq=False)
class ViewCrossings:
    """The m crossings of a view on which depth is judged: judged ones between bars that are straight there.

    ``crossing`` holds indices into the scene's crossings, whose number is ``in_scene``. ``visible`` are the
    parts of bar a and bar b of the first crossing, then of the second, and so on. ``ties`` are the true tie
    points in the camera frame, and ``width_px`` the width of the thinner bar in the image.
    """

    in_scene: int
    crossing: Int64[ndarray, " m"]
    visible: VisibleSegments
    ties: TiePoints
    radius_m: Float64[ndarray, "m 2"]
    width_px: Float64[ndarray, " m"]


def view_crossings(truth: SteelTruth, scene: SceneCrossings) -> ViewCrossings:
    """Return the crossings of a view on which depth is judged."""
    straight = scene.straight[truth.judged.crossing].all(axis=1)
    crossing, pixels = truth.judged.crossing[straight], truth.judged.pixels[straight]
    pixels = pixels.reshape(2 * len(crossing), pixels.shape[2])
    rotation = truth.cam_from_world[:3, :3]
    lines = AxisLines(
        segment=np.repeat(crossing, 2),
        diameter_m=scene.diameter_m[crossing].ravel(),
        match_radius_m=scene.match_radius_m[crossing].ravel(),
        start_m=transform(truth.cam_from_world, scene.point_m[crossing].reshape(-1, 3)),
        direction=scene.tangent[crossing].reshape(-1, 3) @ rotation.T,
    )
    visible = visible_parts(truth, lines, pixels, np.ones(pixels.shape, dtype=bool))
    found = scene.crossings
    ties = TiePoints(
        transform(truth.cam_from_world, found.tie_point_m[crossing]),
        found.normal[crossing] @ rotation.T,
        found.gap_m[crossing],
        found.angle_deg[crossing],
    )
    width_px = truth.K[0, 0] * scene.diameter_m[crossing].min(axis=1, initial=np.inf) / ties.tie_point_m[:, 2]
    return ViewCrossings(len(scene), crossing, visible, ties, scene.diameter_m[crossing] / 2, width_px)


@dataclass(frozen=True, eq=False)
class FittedTies:
    """Tie points of the fitted axes of m crossings, camera frame; ``located`` where both bars were found."""

    located: Bool[ndarray, " m"]
    ties: TiePoints


def fitted_ties(p_m: Float64[ndarray, " n"], view: ViewCrossings) -> FittedTies:
    """Return the tie points of the cylinders fitted to predicted depth; ``p_m`` as in ``fit_axes``.

    Radii, the pixels of each bar and their positions along its axis are the true ones, and the normal is on the
    side of the true one. Numbers of crossings that are not located have no meaning.
    """
    fitted = fit_axes(p_m, view.visible, np.zeros(len(view.visible.segment), dtype=bool))
    with np.errstate(all="ignore"):
        points_m = _closest_points_m(fitted)
        direction = fitted.direction.reshape(-1, 2, 3)
        ties = tie_points(
            points_m[0], points_m[1], direction[:, 0], direction[:, 1], view.radius_m, towards=view.ties.normal
        )
    return FittedTies(fitted.found.reshape(-1, 2).all(axis=1), ties)


def _closest_points_m(fitted: FittedAxes) -> tuple[Float64[ndarray, "m 3"], Float64[ndarray, "m 3"]]:
    """Return the points of the fitted axes a and b of each crossing that are closest to each other."""
    point_m, direction = fitted.point_m.reshape(-1, 2, 3), fitted.direction.reshape(-1, 2, 3)
    a, b = direction[:, 0], direction[:, 1]
    between_m = point_m[:, 0] - point_m[:, 1]
    cosine, along_a, along_b = (np.einsum("mi,mi->m", u, v) for u, v in ((a, b), (a, between_m), (b, between_m)))
    determinant = 1 - cosine**2
    step_a = (cosine * along_b - along_a) / determinant
    step_b = (along_b - cosine * along_a) / determinant
    return point_m[:, 0] + step_a[:, None] * a, point_m[:, 1] + step_b[:, None] * b


def crossing_samples(p_m: Float64[ndarray, " n"], view: ViewCrossings) -> Samples:
    """Return the crossing samples of one view; ``crossings.measures`` defines what each is.

    ``p_m`` is planar depth on the pixels of ``SteelTruth`` in metres, NaN where missing. Errors named
    ``..._error_...`` are signed and of located crossings, those named ``..._judged_...`` absolute and of all.
    ``crossing_z_m`` is the true depth of each tie point, in the order of the judged errors.
    """
    fitted = fitted_ties(p_m, view)
    true, found, located = view.ties, fitted.ties, fitted.located
    with np.errstate(all="ignore"):
        offset_mm = _known((found.tie_point_m - true.tie_point_m) * _MM, located)
        gap_mm = _known((found.gap_m - true.gap_m) * _MM, located)
        angle_deg = _known(found.angle_deg - true.angle_deg, located)
        cosine = np.einsum("mi,mi->m", found.normal, true.normal)
        normal_deg = _known(np.rad2deg(np.arccos(np.clip(np.abs(cosine), 0, 1))), located)
        error_mm = with_misses(np.linalg.norm(offset_mm, axis=1))
        across_mm = with_misses(np.hypot(offset_mm[:, 0], offset_mm[:, 1]))
    judged_mm = {"tie": error_mm, "tie_along": with_misses(offset_mm[:, 2]), "tie_across": across_mm}
    judged_mm["crossing_gap"] = with_misses(gap_mm)
    signed_mm = {"right": offset_mm[:, 0], "down": offset_mm[:, 1], "along": offset_mm[:, 2]}
    return {
        "crossings_judged": np.array([len(located) / view.in_scene] if view.in_scene else []),
        "crossing_located": located.astype(np.float64),
        **{f"{name}_judged_mm": values for name, values in judged_mm.items()},
        **{f"tie_{name}_error_mm": values[~np.isnan(values)] for name, values in signed_mm.items()},
        "crossing_gap_error_mm": gap_mm[~np.isnan(gap_mm)],
        "crossing_angle_judged_deg": with_misses(angle_deg, MISS_DEG),
        "crossing_normal_judged_deg": with_misses(normal_deg, MISS_DEG),
        **{f"tie_within_{limit}mm": (error_mm <= limit).astype(np.float64) for limit in WITHIN_MM},
        "crossing_z_m": true.tie_point_m[:, 2],
        **_binned_samples(error_mm, located, view),
    }


def _known(values: ndarray, located: Bool[ndarray, " m"]) -> ndarray:
    """Return values as they are where a crossing is located, else NaN."""
    return np.where(located.reshape(-1, *(1,) * (values.ndim - 1)), values, np.nan)


def _binned_samples(
    error_mm: Float64[ndarray, " m"], located: Bool[ndarray, " m"], view: ViewCrossings
) -> dict[str, Float64[ndarray, " k"]]:
    """Return the samples of the shares by true distance, angle, gap and width."""
    gap_mm = view.ties.gap_m * _MM
    properties = {
        "m": view.ties.tie_point_m[:, 2],
        "deg": view.ties.angle_deg,
        "mm": gap_mm,
        "px": view.width_px,
    }
    samples: dict[str, Float64[ndarray, " k"]] = {}
    for unit, edges in BINS.items():
        for low, high in pairwise(edges):
            inside = (properties[unit] >= low) & (properties[unit] < high)
            inside |= (properties[unit] == high) & (high == edges[-1])
            samples |= _shares(f"{low:g}-{high:g}{unit}", unit, error_mm[inside], located[inside])
    negative = gap_mm < 0
    return {**samples, **_shares(NEGATIVE_GAP, "mm", error_mm[negative], located[negative])}


def _shares(
    name: str, unit: str, error_mm: Float64[ndarray, " k"], located: Bool[ndarray, " k"]
) -> dict[str, Float64[ndarray, " k"]]:
    """Return the samples of one bin."""
    names = DISTANCE_BINS if unit == "m" else CROSSING_BINS
    values = {"located": located.astype(np.float64)}
    values |= {f"within_{limit}mm": (error_mm <= limit).astype(np.float64) for limit in WITHIN_MM}
    return {f"tie_{share}_at_{name}": values[share] for share in names}
