"""Judged crossings of a view, decided by the ground truth of the left eye alone, and the pixels that they use.

A crossing is judged if the pixel of its tie point shows one of its bars, and if each bar has at least
``MIN_PIXELS`` single-bar interior pixels on its side within ``WINDOW_DIAMETERS`` along its axis, on both sides of
the crossing and over ``MIN_VISIBLE_DIAMETERS`` or more. Measures of depth further need both bars to be straight
there (``SceneCrossings.straight``).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from rebar_depth_bench.extended.crossings.scene import WINDOW_DIAMETERS, SceneCrossings
from rebar_depth_bench.extended.inspection.segments import SURFACE_DISTANCE_RADII
from rebar_depth_bench.extended.inspection.visible_segments import (
    GOLDEN,
    MIN_PIXELS,
    MIN_VISIBLE_DIAMETERS,
)
from rebar_depth_bench.extended.steel_truth import JudgedCrossings, SteelTruth
from rebar_depth_bench.geometry.cameras import fold_radius, project, transform

SAMPLED_PIXELS = MIN_PIXELS
"""Number of pixels of each bar that are fitted at a crossing, spread evenly along it."""


def judged_crossings(truth: SteelTruth, scene: SceneCrossings) -> JudgedCrossings:
    """Return the judged crossings of a view, and the sampled pixels of both bars of each."""
    shown = shown_bars(truth, transform(truth.cam_from_world, scene.crossings.tie_point_m))
    candidates = np.flatnonzero((shown[:, None] == scene.bar_id).any(axis=1))
    bar_pixels = _BarPixels(truth, scene)
    judged, pixels = [], []
    for crossing in candidates.tolist():
        sides = [bar_pixels.sampled(crossing, side) for side in (0, 1)]
        if all(len(side) for side in sides):
            judged.append(crossing)
            pixels.append(sides)
    return JudgedCrossings(
        np.array(judged, dtype=np.int64), np.array(pixels, dtype=np.int64).reshape(-1, 2, SAMPLED_PIXELS)
    )


def shown_bars(truth: SteelTruth, points_m: Float64[ndarray, "n 3"]) -> Int64[ndarray, " n"]:
    """Return the bar id at the nearest pixel of each point (camera frame, metres).

    It is 0 beside the steel, outside of the image and behind the camera.
    """
    bars = np.zeros(len(points_m), np.int64)
    in_front = points_m[:, 2] > 0
    ray = points_m[:, :2] / np.where(in_front, points_m[:, 2], 1.0)[:, None]
    in_front &= np.linalg.norm(ray, axis=1) < fold_radius(truth.distortion)
    pixel = np.floor(project(truth.K, points_m[in_front], truth.distortion) + 0.5)
    size = np.array([truth.width, truth.height])
    inside = ((pixel >= 0) & (pixel < size)).all(axis=1)
    flat = pixel[inside, 1].astype(np.int64) * truth.width + pixel[inside, 0].astype(np.int64)
    position = np.minimum(np.searchsorted(truth.index, flat), max(len(truth.index) - 1, 0))
    known = (truth.index[position] == flat) if len(truth.index) else np.zeros(len(flat), bool)
    bars[np.flatnonzero(in_front)[inside][known]] = truth.bar_id[position[known]]
    return bars


class _BarPixels:
    """Single-bar interior pixels of the bars of a view by their place along the axis, computed on demand."""

    def __init__(self, truth: SteelTruth, scene: SceneCrossings) -> None:
        self._truth, self._scene = truth, scene
        candidates = np.flatnonzero(truth.single_bar)
        order = np.argsort(truth.bar_id[candidates], kind="stable")
        self._pixels = candidates[order]
        self._bar_id = truth.bar_id[self._pixels]
        self._known: dict[int, tuple[ndarray, ndarray]] = {}

    def sampled(self, crossing: int, side: int) -> Int64[ndarray, " k"]:
        """Return the sampled pixels of one bar of a crossing, none if the bar does not suffice to judge it."""
        scene, bar_id = self._scene, int(self._scene.bar_id[crossing, side])
        axis = scene.axes[bar_id]
        pixels, along_m = self._of_bar(bar_id)
        relative_m = axis.relative_m(along_m, float(scene.along_m[crossing, side]))
        near = np.flatnonzero(np.abs(relative_m) <= WINDOW_DIAMETERS * axis.diameter_m)
        if len(near) < MIN_PIXELS:
            return np.empty(0, np.int64)
        low_m, high_m = relative_m[near].min(), relative_m[near].max()
        if not low_m < 0 < high_m or high_m - low_m < MIN_VISIBLE_DIAMETERS * axis.diameter_m:
            return np.empty(0, np.int64)
        ordered = near[np.argsort(relative_m[near], kind="stable")]
        # Multiples of the golden ratio: regular strides can coincide with ribs or with the width of a bar.
        spread = np.floor(len(ordered) * ((np.arange(SAMPLED_PIXELS) + 0.5) * GOLDEN % 1.0)).astype(np.int64)
        return np.asarray(pixels[ordered[spread]])

    def _of_bar(self, bar_id: int) -> tuple[Int64[ndarray, " n"], Float64[ndarray, " n"]]:
        """Return the pixels on the side of a bar, ascending, and their places along its axis, metres."""
        if bar_id not in self._known:
            first, last = np.searchsorted(self._bar_id, [bar_id, bar_id + 1])
            pixels, truth = self._pixels[first:last], self._truth
            rays = np.column_stack([truth.rays[pixels], np.ones(len(pixels))])
            camera_m = truth.depth_m[pixels].astype(np.float64)[:, None] * rays
            rotation, shift_m = truth.cam_from_world[:3, :3], truth.cam_from_world[:3, 3]
            axis = self._scene.axes[bar_id]
            along_m, distance_m = axis.feet((camera_m - shift_m) @ rotation)
            radii = distance_m / (axis.diameter_m / 2)
            on_side = (radii >= SURFACE_DISTANCE_RADII[0]) & (radii <= SURFACE_DISTANCE_RADII[1])
            self._known[bar_id] = pixels[on_side], along_m[on_side]
        return self._known[bar_id]
