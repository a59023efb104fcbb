"""Crossing measures of a view: cylinders fitted to both bars of each judged crossing, and their tie points.

At each crossing, cylinders of the nominal diameters are fitted to the predicted depth of the sampled pixels of
both bars, as the inspection does for whole runs. Their closest points give tie point, gap, angle and normal.
Frame: the camera's, metres. What is judged depends on the ground truth alone, so a missing prediction counts as
a failure.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from rebar_depth_bench.bar_crossings.definition import TiePoints, tie_points
from rebar_depth_bench.extended.crossings.measures import (
    BINS,
    CROSSING_BINS,
    DISTANCE_BINS,
    MISS_DEG,
    NEGATIVE_GAP,
    WITHIN_MM,
)
from rebar_depth_bench.extended.crossings.scene import SceneCrossings
from rebar_depth_bench.extended.inspection.axis_fits import FittedAxes, fit_axes, with_misses
from rebar_depth_bench.extended.inspection.visible_segments import AxisLines, VisibleSegments, visible_parts
from rebar_depth_bench.extended.measures import Samples
from rebar_depth_bench.extended.steel_truth import SteelTruth
from rebar_depth_bench.geometry.cameras import transform

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
