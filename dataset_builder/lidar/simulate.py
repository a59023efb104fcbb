"""A scan: every beam of a sector cast against the scene's mesh, one range or none for each.

What a scanner hears of one beam: sub-rays' hits become returns, and one of them is reported, or none.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
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
    """Return each beam's reported range, metres; NaN where no return is heard.

    ``range_m`` holds the ranges of the sub-rays' hits (infinity: none) and ``cos_incidence`` the cosines of their
    angles of incidence, by which a rough surface scatters back (Lambert). Going outwards, a hit and all hits
    within the range resolution behind it are one return, at the mean of their ranges weighted by intensity. So no
    reported range mixes surfaces that are further apart than that.
    """
    heard = (range_m >= spec.min_range_m) & (range_m <= spec.max_range_m)
    light = np.where(heard, cos_incidence, 0.0)
    least = spec.least_share * range_m.shape[1]
    span_m = _span_m(range_m, heard)
    found = np.full(len(range_m), np.nan)
    single = heard.any(axis=1) & (span_m <= spec.range_resolution_m)
    found[single] = _mean_m(range_m[single], light[single], least)
    several = span_m > spec.range_resolution_m
    found[several] = _of_several(spec, range_m[several], light[several], heard[several])
    return found


def _span_m(range_m: Float64[ndarray, "n r"], heard: Bool[ndarray, "n r"]) -> Float64[ndarray, " n"]:
    """Return how far each beam's nearest and farthest heard hits are apart; minus infinity where there is none."""
    farthest_m = np.where(heard, range_m, 0.0).max(axis=1)
    return np.asarray(farthest_m - np.where(heard, range_m, np.inf).min(axis=1))


def _mean_m(
    range_m: Float64[ndarray, "n r"], light: Float64[ndarray, "n r"], least: float
) -> Float64[ndarray, " n"]:
    """Return the intensity-weighted mean range of each beam's heard hits, NaN where they are too weak."""
    total = light.sum(axis=1)
    moment = np.where(light > 0, range_m, 0.0) * light
    enough = (total >= least) & (total > 0)
    return np.where(enough, moment.sum(axis=1) / np.where(enough, total, 1.0), np.nan)


def _of_several(
    spec: ScannerSpec,
    range_m: Float64[ndarray, "n r"],
    light: Float64[ndarray, "n r"],
    heard: Bool[ndarray, "n r"],
) -> Float64[ndarray, " n"]:
    """Return the reported range of beams that may have several returns: strongest or first strong enough."""
    order = np.argsort(np.where(heard, range_m, np.inf), axis=1, kind="stable")
    outwards_m, light, heard = (np.take_along_axis(values, order, axis=1) for values in (range_m, light, heard))
    beams, best = len(range_m), np.full(len(range_m), np.nan)
    least = spec.least_share * light.shape[1]
    most, start_m = np.zeros(beams), np.full(beams, -np.inf)
    total, moment = np.zeros(beams), np.zeros(beams)
    for ray in range(outwards_m.shape[1] + 1):
        last = ray == outwards_m.shape[1]
        here_m = np.full(beams, np.inf) if last else np.where(heard[:, ray], outwards_m[:, ray], np.inf)
        opens = here_m > start_m + spec.range_resolution_m
        wins = opens & (total >= least) & (total > most)
        if spec.reports == "first":
            wins &= np.isnan(best)
        best[wins], most[wins] = moment[wins] / total[wins], total[wins]
        if last:
            break
        start_m = np.where(opens, here_m, start_m)
        total, moment = np.where(opens, 0.0, total), np.where(opens, 0.0, moment)
        total += light[:, ray]
        moment += light[:, ray] * np.where(heard[:, ray], outwards_m[:, ray], 0.0)
    return best


_RAYS_AT_ONCE = 1 << 18
"""Bounds memory: about 50 MB of rays, hits and what is made of them."""


def scan(
    caster: RayCaster,
    spec: ScannerSpec,
    sector: Sector,
    lidar_from_world: Float64[ndarray, "4 4"],
    generator: np.random.Generator,
) -> Float64[ndarray, "rows columns"]:
    """Return every beam's reported range, metres, noise included; NaN where nothing is heard."""
    world_from_lidar = inverse_rigid(lidar_from_world)
    row, column = sector.beams()
    range_m = np.full(len(row), np.nan)
    for part in _parts(len(row), max(_RAYS_AT_ONCE // spec.rays_per_beam, 1)):
        origins, directions = sub_rays(spec, *beam_angles(spec, row[part], column[part]))
        hits = caster.hits(
            transform(world_from_lidar, origins).reshape(-1, 3),
            (directions @ world_from_lidar[:3, :3].T).reshape(-1, 3),
        )
        shape = directions.shape[:2]
        range_m[part] = reported_range_m(spec, hits.range_m.reshape(shape), hits.cos_incidence.reshape(shape))
    # A number for every beam, heard or not: one beam's noise does not hang on what another meets.
    noise = generator.standard_normal(len(row))
    range_m += (spec.noise_m + spec.noise_per_m * range_m) * noise
    return range_m.reshape(sector.rows, sector.columns)


def noise_generator(view_id: str) -> np.random.Generator:
    """Return the generator of a view's noise: it depends on the view's id alone."""
    return np.random.default_rng(int.from_bytes(hashlib.sha256(view_id.encode()).digest()[:8], "little"))


def _parts(count: int, size: int) -> Iterator[slice]:
    for start in range(0, count, size):
        yield slice(start, start + size)
