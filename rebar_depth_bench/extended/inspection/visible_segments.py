"""Which straight runs a view shows well enough to be judged, and the pixels they are judged on.

Decided by the ground truth alone. Frame: the camera's (OpenCV axes), metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from rebar_depth_bench.extended.inspection.segments import CageTruth
from rebar_depth_bench.extended.steel_truth import SteelTruth

MIN_PIXELS = 30
"""A run with fewer interior pixels on it is not judged."""

MIN_VISIBLE = 3.0
"""A run must show this many diameters of its length from its first interior pixel to its last."""

MAX_SAMPLES = 64
"""A run is judged on at most this many of its interior pixels, spread evenly."""

WIDE_PX = 8.0
"""A bar at least this many pixels wide (f d / z) has its diameter measured."""

AROUND = (0.4, 0.1)
"""And it must be seen on both sides: beyond 0.4 radii to either side of its middle lies a tenth of its pixels."""

_GOLDEN = (np.sqrt(5.0) - 1) / 2


@dataclass(frozen=True, eq=False)
class SeenRuns:
    """The runs of a view that are judged, r of them, each on up to k pixels.

    ``run`` are indices into ``CageTruth.runs``. ``middle_m`` is the axis point in the middle of the visible part,
    ``half_m`` half that part's length. ``frame`` holds three unit vectors: across the line of sight, away from the
    camera, along the axis. ``pixels`` are positions in the arrays of ``SteelTruth``, ``used`` tells which of the k
    places hold one, ``rays`` are their rays in ``frame``, per metre of planar depth: see ``local_points_m``.
    ``truth_m`` are the true points. ``wide`` tells where the diameter can be measured.
    """

    run: Int64[ndarray, " r"]
    diameter_m: Float64[ndarray, " r"]
    reach_m: Float64[ndarray, " r"]
    middle_m: Float64[ndarray, "r 3"]
    half_m: Float64[ndarray, " r"]
    frame: Float64[ndarray, "r 3 3"]
    pixels: Int64[ndarray, "r k"]
    used: Bool[ndarray, "r k"]
    rays: Float64[ndarray, "r k 3"]
    truth_m: Float64[ndarray, "r k 3"]
    wide: Bool[ndarray, " r"]

    def local_points_m(self, depth_m: Float64[ndarray, "r k"]) -> Float64[ndarray, "r k 3"]:
        """Return the points at planar ``depth_m`` on the rays of ``pixels``, in ``frame`` from ``middle_m``."""
        middle_m = np.einsum("rij,rj->ri", self.frame, self.middle_m)
        return np.asarray(depth_m[..., None] * self.rays - middle_m[:, None])


def seen_runs(truth: SteelTruth, cage: CageTruth) -> SeenRuns:
    """Return the runs with ``MIN_PIXELS`` interior pixels over ``MIN_VISIBLE`` diameters, and their samples."""
    run, pixels, used = _sampled_pixels(truth)
    rotation, shift_m = truth.cam_from_world[:3, :3], truth.cam_from_world[:3, 3]
    start_m = cage.start_m[run] @ rotation.T + shift_m
    axis_m = (cage.end_m[run] - cage.start_m[run]) @ rotation.T
    direction = axis_m / np.linalg.norm(axis_m, axis=1, keepdims=True)
    rays = np.concatenate([truth.rays.take(pixels, axis=0), np.ones((*pixels.shape, 1))], axis=-1)
    depth_m = truth.depth_m.take(pixels).astype(np.float64)
    along_m = depth_m * (rays @ direction[..., None])[..., 0] - np.einsum("ri,ri->r", start_m, direction)[:, None]
    low_m = np.where(used, along_m, np.inf).min(axis=1, initial=np.inf)
    high_m = np.where(used, along_m, -np.inf).max(axis=1, initial=-np.inf)
    middle_m = start_m + ((low_m + high_m) / 2)[:, None] * direction
    frame = _frames(middle_m, direction)
    local_rays = rays @ frame.transpose(0, 2, 1)
    truth_m = depth_m[..., None] * local_rays - np.einsum("rij,rj->ri", frame, middle_m)[:, None]
    diameter_m = cage.diameter_m[run]
    wide = _is_wide(truth_m[..., 0], used, diameter_m, float(truth.K[0, 0]), middle_m[:, 2])
    kept = high_m - low_m >= MIN_VISIBLE * diameter_m
    every = (run, diameter_m, cage.reach_m[run], middle_m, (high_m - low_m) / 2, frame)
    return SeenRuns(*(values[kept] for values in (*every, pixels, used, local_rays, truth_m, wide)))


def _sampled_pixels(
    truth: SteelTruth,
) -> tuple[Int64[ndarray, " r"], Int64[ndarray, "r k"], Bool[ndarray, "r k"]]:
    """Return the runs with enough interior pixels, and up to ``MAX_SAMPLES`` of each run's, evenly spread.

    Even strides would fall into step with the width of a bar and look at one column of it only; multiples of the
    golden ratio fall into step with nothing.
    """
    judged = np.flatnonzero(truth.interior & (truth.run >= 0))
    runs = truth.run.take(judged)
    by_run = judged.take(np.argsort(runs, kind="stable"))
    counts = np.bincount(runs)
    run = np.flatnonzero(counts >= MIN_PIXELS)
    first = (np.cumsum(counts) - counts)[run]
    total = counts[run][:, None]
    place = np.arange(MAX_SAMPLES)
    spread = np.floor(total * ((place + 0.5) * _GOLDEN % 1.0)).astype(np.int64)
    used = place < total
    chosen = np.where(total > MAX_SAMPLES, spread, np.where(used, place, 0))
    return run, by_run.take(first[:, None] + chosen), used


def _frames(middle_m: Float64[ndarray, "r 3"], direction: Float64[ndarray, "r 3"]) -> Float64[ndarray, "r 3 3"]:
    """Return unit vectors across the line of sight, away from the camera, along the axis: a right angle each."""
    away = middle_m - np.einsum("ri,ri->r", middle_m, direction)[:, None] * direction
    away_norm = np.linalg.norm(away, axis=1)
    # An axis that points at the camera has no side that looks at it: any will do.
    any_side = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction), axis=1)])
    away = np.where((away_norm > 1e-9)[:, None], away, any_side)
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    return np.stack([np.cross(away, direction), away, direction], axis=1)


def _is_wide(
    across_m: Float64[ndarray, "r k"],
    used: Bool[ndarray, "r k"],
    diameter_m: Float64[ndarray, " r"],
    focal_px: float,
    depth_m: Float64[ndarray, " r"],
) -> Bool[ndarray, " r"]:
    radii, share = AROUND
    beyond_m = (radii * diameter_m / 2)[:, None]
    left = (used & (across_m < -beyond_m)).sum(axis=1)
    right = (used & (across_m > beyond_m)).sum(axis=1)
    seen_round = np.minimum(left, right) >= share * used.sum(axis=1)
    return np.asarray((focal_px * diameter_m >= WIDE_PX * depth_m) & seen_round)
