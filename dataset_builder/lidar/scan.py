"""A scan: every beam of a sector cast against the scene's mesh, one range or none for each."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.lidar.beams import Sector, beam_angles, sub_rays
from dataset_builder.lidar.returns import reported_range_m
from dataset_builder.lidar.scanner import ScannerSpec
from rebar_depth_bench.cameras import inverse_rigid, transform

if TYPE_CHECKING:
    from dataset_builder.raycast import RayCaster

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
