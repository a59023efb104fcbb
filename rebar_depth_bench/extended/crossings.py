"""Crossing measures of a view: cylinders fitted to both bars of each judged crossing, and their tie points.

At each crossing, cylinders of the nominal diameters are fitted to the predicted depth of the sampled pixels of
both bars, as the inspection does for whole runs. Their closest points give tie point, gap, angle and normal.
Frame: the camera's, metres. What is judged depends on the ground truth alone, so a missing prediction counts as
a failure.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from rebar_depth_bench.bar_crossings.definition import TiePoints, tie_points
from rebar_depth_bench.extended.fits import MISS_MM, FittedAxes, fit_axes, with_misses
from rebar_depth_bench.extended.judged import VisibleSegments, visible_parts
from rebar_depth_bench.extended.measures import Measure, Samples, median_and_p95, share_sample
from rebar_depth_bench.extended.profiles import DISTANCE_EDGES_M, WIDTH_EDGES_PX
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.geometry.cameras import transform

WITHIN_MM = (2, 5, 10)
"""Limits of the share of tie points within a distance, mm."""

MISS_DEG = 90.0
"""Error of angle and normal of a crossing that was not located, degrees: the largest one of undirected lines."""

CROSSING_EDGES_M = (0.1, 0.15, *DISTANCE_EDGES_M)
"""Bin edges of the true depth of tie points, metres."""


_BINS: Mapping[str, tuple[tuple[float, ...], str, str]] = {
    "m": (CROSSING_EDGES_M, "At {} m", "at a true depth of {} m"),
    "deg": ((20.0, 30.0, 45.0, 60.0, 75.0, 90.0), "Angle of {} degrees", "at an angle of {} degrees"),
    "mm": ((-math.inf, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0), "Gap of {} mm", "with a gap of {} mm"),
    "px": (WIDTH_EDGES_PX, "Bars of {} px", "whose thinner bar is {} px wide in the image"),
}
"""Bins by true depth of the tie point, angle, gap, and width of the thinner bar in the image, by unit.

Each has edges, and texts for titles and definitions. A bin includes its lower edge, the last one both edges.
"""

_BELOW = "Intersecting bars", "with a negative gap"
"""Texts of the bin without a lower edge."""

_WITHIN = "whose tie point is within {} mm; what is not located fails"
_SHARES: Mapping[str, tuple[str, str]] = {
    "located": ("located", "that are located"),
    **{f"within_{limit}mm": (f"within {limit} mm", _WITHIN.format(limit)) for limit in WITHIN_MM},
}
"""Title and definition of each share of judged crossings."""


def _shares_of_bins(unit: str) -> tuple[str, ...]:
    """Return the shares that are stated for the bins of a unit."""
    return ("within_2mm" if unit == "m" else "located", "within_5mm")


def _bin_name(share: str, unit: str, low: float, high: float) -> str:
    """Return the name of a measure, and of its samples."""
    step = f"{low:g}-{high:g}{unit}" if math.isfinite(low) else "negative-gap"
    return f"tie_{share}_at_{step}"


def _judged_pair(name: str, title: str, unit: str, definition: str) -> tuple[Measure, ...]:
    """Return median and 95th percentile of an absolute error over all judged crossings; ``unit`` is mm or deg."""
    miss, suffix = (f"{MISS_MM:g} mm", "") if unit == "mm" else (f"{MISS_DEG:g} degrees", ", degrees")
    text = f"{definition}. What is not located counts as {miss}."
    return median_and_p95(name, title, unit, text, suffix)


def _bias(name: str, title: str, definition: str) -> Measure:
    return Measure(
        f"{name}_bias_mm", f"{title}: bias", "mm", "", f"Mean over located crossings: {definition}.",
        f"{name}_error_mm",
    )  # fmt: skip


MAIN_MEASURES = (
    Measure(
        "crossings_judged", "crossings judged", "%", "",
        "Mean over views of the share of the scene's crossings that are judged, by the truth alone: the pixel of "
        "the tie point shows one of the bars near it; both are straight there, with 30 single-bar pixels or more.",
    ),
    Measure(
        "crossings_located", "crossings located", "%", "higher",
        "Share of judged crossings whose two fitted cylinders pass the rules of bars_found.", "crossing_located",
    ),
    *_judged_pair(
        "tie", "tie point", "mm",
        "distance of the fitted tie point from the true one: closest points of the cylinders fitted to both bars "
        "within 6 diameters of the crossing",
    ),
    *_judged_pair(
        "tie_along", "tie point along the optical axis", "mm",
        "absolute error of the tie point along the optical axis",
    ),
    *_judged_pair(
        "tie_across", "tie point across the optical axis", "mm", "error of the tie point across the optical axis"
    ),
    _bias(
        "tie_along", "tie point along the optical axis",
        "fitted minus true place along the optical axis; more is further from the camera",
    ),
    _bias(
        "tie_right", "tie point to the right",
        "fitted minus true place along the camera's x axis, to the right of the image",
    ),
    _bias(
        "tie_down", "tie point downwards",
        "fitted minus true place along the camera's y axis, downwards in the image",
    ),
    _bias("crossing_gap", "gap of the surfaces", "fitted minus true gap between the surfaces along the normal"),
    *_judged_pair(
        "crossing_gap", "gap of the surfaces", "mm",
        "absolute error of the gap between the surfaces along the normal",
    ),
    *_judged_pair("crossing_angle", "angle of the bars", "deg", "absolute error of the angle between the axes"),
    *_judged_pair(
        "crossing_normal", "normal", "deg", "undirected angle between fitted and true normal of both axes"
    ),
    *(
        Measure(
            f"tie_within_{limit}mm", f"tie point within {limit} mm", "%", "higher",
            f"Share of judged crossings {_WITHIN.format(limit)}",
        )
        for limit in WITHIN_MM
    ),
)  # fmt: skip
"""Measures of all judged crossings, in table order."""


def _binned_measures() -> Iterator[Measure]:
    """Yield the shares of each bin; shares of one kind are together."""
    for unit, (edges, in_title, in_text) in _BINS.items():
        for share in _shares_of_bins(unit):
            head, text = _SHARES[share]
            for low, high in pairwise(edges):
                step = f"{low:g}-{high:g}"
                title, where = (in_title, in_text) if math.isfinite(low) else _BELOW
                definition = f"Share of judged crossings {where.format(step)} {text}"
                name = _bin_name(share, unit, low, high)
                yield Measure(name, f"{title.format(step)}: {head}", "%", "higher", definition)


BINNED_MEASURES = tuple(_binned_measures())
"""Shares of judged crossings by distance, angle, gap and width, in table order."""

MEASURES = (*MAIN_MEASURES, *BINNED_MEASURES)
"""All crossing measures, in table order."""

_MM = 1000.0


@dataclass(frozen=True, eq=False)
class ViewCrossings:
    """The m crossings of a view on which depth is judged: judged ones between bars that are straight there.

    ``crossing`` holds indices into the scene's crossings, of which there are ``of_scene``. ``visible`` are the
    parts of bar a and bar b of the first crossing, then of the second, and so on. ``ties`` are the true tie points
    in the camera frame, and ``width_px`` the width of the thinner bar in the image.
    """

    of_scene: int
    crossing: Int64[ndarray, " m"]
    visible: VisibleSegments
    ties: TiePoints
    width_px: Float64[ndarray, " m"]


def view_crossings(truth: SteelTruth) -> ViewCrossings:
    """Return the crossings of a view on which depth is judged."""
    scene = truth.bars.crossings
    straight = scene.straight[truth.judged.crossing].all(axis=1)
    crossing, pixels = truth.judged.crossing[straight], truth.judged.pixels[straight]
    pixels = pixels.reshape(2 * len(crossing), pixels.shape[2])
    rotation = truth.cam_from_world[:3, :3]
    visible = visible_parts(
        truth,
        pixels,
        np.ones(pixels.shape, dtype=bool),
        segment=np.repeat(crossing, 2),
        diameter_m=scene.diameter_m[crossing].ravel(),
        match_radius_m=scene.match_radius_m[crossing].ravel(),
        point_m=transform(truth.cam_from_world, scene.point_m[crossing].reshape(-1, 3)),
        direction=scene.tangent[crossing].reshape(-1, 3) @ rotation.T,
    )
    found = scene.crossings
    ties = TiePoints(
        transform(truth.cam_from_world, found.tie_point_m[crossing]),
        found.normal[crossing] @ rotation.T,
        found.gap_m[crossing],
        found.angle_deg[crossing],
    )
    width_px = truth.K[0, 0] * scene.diameter_m[crossing].min(axis=1, initial=np.inf) / ties.tie_point_m[:, 2]
    return ViewCrossings(len(scene), crossing, visible, ties, width_px)


def fitted_ties(p_m: Float64[ndarray, " n"], view: ViewCrossings) -> tuple[Bool[ndarray, " m"], TiePoints]:
    """Return which crossings are located, both bars found, and the tie points of all fitted axes, camera frame.

    Cylinders are fitted to predicted depth; ``p_m`` as in ``fit_axes``. Radii, the pixels of each bar and their
    positions along its axis are the true ones, and the normal is on the side of the true one. Numbers of crossings
    that are not located have no meaning.
    """
    fitted = fit_axes(p_m, view.visible)
    with np.errstate(all="ignore"):
        points_m = _closest_points_m(fitted)
        direction, radius_m = fitted.direction.reshape(-1, 2, 3), view.visible.diameter_m.reshape(-1, 2) / 2
        ties = tie_points(*points_m, direction[:, 0], direction[:, 1], radius_m, towards=view.ties.normal)
    return fitted.found.reshape(-1, 2).all(axis=1), ties


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
    """Return the crossing samples of one view; the measures define what each is.

    ``p_m`` is planar depth on the pixels of ``SteelTruth`` in metres, NaN where missing. ``..._error_...`` are
    signed errors of located crossings, ``..._judged_...`` absolute errors of all crossings. ``crossing_z_m`` is
    the true depth of each tie point, in the order of the judged errors.
    """
    located, found = fitted_ties(p_m, view)
    true = view.ties
    with np.errstate(all="ignore"):
        offset_mm = np.where(located[:, None], (found.tie_point_m - true.tie_point_m) * _MM, np.nan)
        gap_mm = np.where(located, (found.gap_m - true.gap_m) * _MM, np.nan)
        angle_deg = np.where(located, found.angle_deg - true.angle_deg, np.nan)
        cosine = np.einsum("mi,mi->m", found.normal, true.normal)
        normal_deg = np.where(located, np.rad2deg(np.arccos(np.clip(np.abs(cosine), 0, 1))), np.nan)
        error_mm = with_misses(np.linalg.norm(offset_mm, axis=1))
        across_mm = with_misses(np.hypot(offset_mm[:, 0], offset_mm[:, 1]))
    signed_mm = {
        "tie_right": offset_mm[:, 0],
        "tie_down": offset_mm[:, 1],
        "tie_along": offset_mm[:, 2],
        "crossing_gap": gap_mm,
    }
    shares = {
        "located": located.astype(np.float64),
        **{f"within_{limit}mm": (error_mm <= limit).astype(np.float64) for limit in WITHIN_MM},
    }
    return {
        "crossings_judged": share_sample(len(located), view.of_scene),
        "crossing_located": shares["located"],
        "tie_judged_mm": error_mm,
        "tie_along_judged_mm": with_misses(offset_mm[:, 2]),
        "tie_across_judged_mm": across_mm,
        "crossing_gap_judged_mm": with_misses(gap_mm),
        "crossing_angle_judged_deg": with_misses(angle_deg, MISS_DEG),
        "crossing_normal_judged_deg": with_misses(normal_deg, MISS_DEG),
        **{f"{name}_error_mm": values[~np.isnan(values)] for name, values in signed_mm.items()},
        **{f"tie_within_{limit}mm": shares[f"within_{limit}mm"] for limit in WITHIN_MM},
        "crossing_z_m": true.tie_point_m[:, 2],
        **_binned_samples(shares, view),
    }


def _binned_samples(shares: Mapping[str, Float64[ndarray, " m"]], view: ViewCrossings) -> Samples:
    """Return the samples of the shares by true distance, angle, gap and width."""
    properties = {
        "m": view.ties.tie_point_m[:, 2],
        "deg": view.ties.angle_deg,
        "mm": view.ties.gap_m * _MM,
        "px": view.width_px,
    }
    samples: dict[str, Float64[ndarray, " k"]] = {}
    for unit, (edges, _, _) in _BINS.items():
        for low, high in pairwise(edges):
            values = properties[unit]
            inside = (values >= low) & ((values < high) | ((values == high) & (high == edges[-1])))
            samples |= {_bin_name(name, unit, low, high): shares[name][inside] for name in _shares_of_bins(unit)}
    return samples
