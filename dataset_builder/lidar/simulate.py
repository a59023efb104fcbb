"""Scan simulation: casts every beam of a sector against the scene's mesh and reports at most one range for each.

The hits of a beam's sub-rays are grouped into returns, of which one or none is reported.
"""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from dataset_builder.lidar.beams import Sector, beam_angles, sub_rays
from dataset_builder.lidar.scanner import ScannerSpec
from rebar_depth_bench.geometry.cameras import inverse_rigid, transform

if TYPE_CHECKING:
    from dataset_builder.scene.raycast import RayCaster


def reported_range_m(
    spec: ScannerSpec, range_m: Float64[ndarray, "n r"], cos_incidence: Float64[ndarray, "n r"]
) -> Float64[ndarray, " n"]:
    """Return each beam's reported range, metres; NaN where no return is detected.

    ``range_m`` holds the ranges of the sub-rays' hits (inf: none) and ``cos_incidence`` the cosines of their
    angles of incidence, which weight the light that a rough surface scatters back (Lambert). With increasing
    range, a hit and all hits within the range resolution behind it form one return, at the mean of their ranges
    weighted by intensity. No reported range therefore mixes surfaces that are farther apart than that.
    """
    detectable = (range_m >= spec.min_range_m) & (range_m <= spec.max_range_m)
    intensity = np.where(detectable, cos_incidence, 0.0)
    min_intensity = spec.least_share * range_m.shape[1]
    span_m = _span_m(range_m, detectable)
    reported_m = np.full(len(range_m), np.nan)
    single = detectable.any(axis=1) & (span_m <= spec.range_resolution_m)
    reported_m[single] = _single_return_m(range_m[single], intensity[single], min_intensity)
    several = span_m > spec.range_resolution_m
    reported_m[several] = _select_return_m(spec, range_m[several], intensity[several], detectable[several])
    return reported_m


def _span_m(range_m: Float64[ndarray, "n r"], detectable: Bool[ndarray, "n r"]) -> Float64[ndarray, " n"]:
    """Return the distance between each beam's nearest and farthest detectable hits; minus infinity without any."""
    farthest_m = np.where(detectable, range_m, 0.0).max(axis=1)
    return np.asarray(farthest_m - np.where(detectable, range_m, np.inf).min(axis=1))


def _single_return_m(
    range_m: Float64[ndarray, "n r"], intensity: Float64[ndarray, "n r"], min_intensity: float
) -> Float64[ndarray, " n"]:
    """Return the intensity-weighted mean range of each beam's detectable hits, NaN where they are too weak."""
    total = intensity.sum(axis=1)
    moment = np.where(intensity > 0, range_m, 0.0) * intensity
    strong_enough = (total >= min_intensity) & (total > 0)
    return np.where(strong_enough, moment.sum(axis=1) / np.where(strong_enough, total, 1.0), np.nan)


def _select_return_m(
    spec: ScannerSpec,
    range_m: Float64[ndarray, "n r"],
    intensity: Float64[ndarray, "n r"],
    detectable: Bool[ndarray, "n r"],
) -> Float64[ndarray, " n"]:
    """Return the reported range of beams that may have several returns.

    It is that of the strongest return, or of the first one that is strong enough, by ``spec.reports``.
    """
    order = np.argsort(np.where(detectable, range_m, np.inf), axis=1, kind="stable")
    sorted_range_m, intensity, detectable = (
        np.take_along_axis(values, order, axis=1) for values in (range_m, intensity, detectable)
    )
    beams, reported_m = len(range_m), np.full(len(range_m), np.nan)
    min_intensity = spec.least_share * intensity.shape[1]
    highest_total, start_m = np.zeros(beams), np.full(beams, -np.inf)
    total, moment = np.zeros(beams), np.zeros(beams)
    for ray in range(sorted_range_m.shape[1] + 1):
        last = ray == sorted_range_m.shape[1]
        hit_m = np.full(beams, np.inf) if last else np.where(detectable[:, ray], sorted_range_m[:, ray], np.inf)
        starts_return = hit_m > start_m + spec.range_resolution_m
        is_better = starts_return & (total >= min_intensity) & (total > highest_total)
        if spec.reports == "first":
            is_better &= np.isnan(reported_m)
        reported_m[is_better], highest_total[is_better] = moment[is_better] / total[is_better], total[is_better]
        if last:
            break
        start_m = np.where(starts_return, hit_m, start_m)
        total, moment = np.where(starts_return, 0.0, total), np.where(starts_return, 0.0, moment)
        total += intensity[:, ray]
        moment += intensity[:, ray] * np.where(detectable[:, ray], sorted_range_m[:, ray], 0.0)
    return reported_m


_MAX_RAYS_PER_BATCH = 1 << 18
"""Maximum number of sub-rays per batch; bounds memory to about 50 MB of rays, hits and intermediate arrays."""


def simulate_scan(
    caster: RayCaster,
    spec: ScannerSpec,
    sector: Sector,
    lidar_from_world: Float64[ndarray, "4 4"],
    generator: np.random.Generator,
) -> Float64[ndarray, "rows columns"]:
    """Return every beam's reported range, metres, noise included; NaN where no return is detected."""
    world_from_lidar = inverse_rigid(lidar_from_world)
    row, column = sector.beams()
    range_m = np.full(len(row), np.nan)
    batch_size = max(_MAX_RAYS_PER_BATCH // spec.rays_per_beam, 1)
    for start in range(0, len(row), batch_size):
        batch = slice(start, start + batch_size)
        origins, directions = sub_rays(spec, *beam_angles(spec, row[batch], column[batch]))
        hits = caster.hits(
            transform(world_from_lidar, origins).reshape(-1, 3),
            (directions @ world_from_lidar[:3, :3].T).reshape(-1, 3),
        )
        shape = directions.shape[:2]
        range_m[batch] = reported_range_m(spec, hits.range_m.reshape(shape), hits.cos_incidence.reshape(shape))
    # One number is drawn for every beam, with or without a return, so that a beam's noise does not depend on other
    # beams.
    noise = generator.standard_normal(len(row))
    range_m += (spec.noise_m + spec.noise_per_m * range_m) * noise
    return range_m.reshape(sector.rows, sector.columns)


def noise_generator(view_id: str) -> np.random.Generator:
    """Return the noise generator of a view; its seed depends on the view id alone."""
    return np.random.default_rng(int.from_bytes(hashlib.sha256(view_id.encode()).digest()[:8], "little"))
