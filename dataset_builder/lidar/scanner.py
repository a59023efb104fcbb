"""Laser scanner model: beam grid, beam shape, returns, range and noise; two instances of real scanner classes.

Scanner frame: x right, y down, z forward, parallel to the left camera's. Azimuth is positive to the right,
elevation is positive upwards. Beam (row, column) has elevation (row + 1/2) steps and azimuth (column + 1/2)
steps, so that cells of one step tile all directions. The hits of a beam's sub-rays are grouped into returns, of
which the strongest or none is reported.

Reflectivity is not modelled: all surfaces scatter alike (Lambertian). Neither is the decrease of intensity with
the square of range: surfaces mixed in one return are close to each other, and among separate returns the nearer
one is not favoured.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from dataset_builder.scene.raycast import RayCaster
from rebar_depth_bench.geometry.cameras import inverse_rigid, transform

_SIGMAS_PER_1E_WIDTH = 2.0 * math.sqrt(2.0)
"""Full width of exp(-r^2 / (2 sigma^2)) at 1/e of the peak, as in IEC 60825-1 (laser safety), in sigma.

The same factors apply to diameters and full angles.
"""

_SIGMAS_PER_FWHM = 2.0 * math.sqrt(2.0 * math.log(2.0))
"""Full width at half of the peak, in sigma."""

_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
"""Golden ratio minus 1."""

_ROUNDING = 1e-9
"""Tolerance of the elevation limits, in steps."""

_MAX_RAYS_PER_BATCH = 1 << 18
"""Maximum number of sub-rays per batch; bounds memory to about 50 MB of rays, hits and intermediate arrays."""

Angles = tuple[Float64[ndarray, "*n"], Float64[ndarray, "*n"]]
"""Azimuth and elevation, radians."""


@dataclass(frozen=True)
class ScannerSpec:
    """Parameters of a scanner whose axes are parallel to the left camera's.

    - ``azimuth_step_rad``, ``elevation_step_rad``: angle between neighbouring beams; a beam represents a cell of
      this size.
    - ``elevation_limits_rad``: lowest and highest beam, up positive.
    - ``divergence_sigma_rad``, ``exit_sigma_m``: one sigma of the Gaussian beam's angle and radius at the exit, in
      each direction.
    - ``rays_per_beam``: sub-rays that sample one beam: 1 (its axis) or an even number.
    - ``range_resolution_m``: hits of one beam within this distance behind its nearest surface form one return. It
      should exceed the depth extent of the footprint on slanted surfaces, which otherwise split into weak
      returns.
    - ``least_share``: minimum share of the emitted light, at normal incidence, that a return must contain to be
      detected.
    - ``min_range_m``, ``max_range_m``: a surface outside these is not detected, but still occludes. The minimum is
      above 0, because parallax grows without bound towards range 0.
    - ``noise_m``: one sigma of a reported range.
    - ``position_left_m``: the scanner's centre in the left camera's frame, metres; 60 mm above it by default.

    Raises ``ValueError`` for inconsistent parameters.
    """

    azimuth_step_rad: float
    elevation_step_rad: float
    elevation_limits_rad: tuple[float, float]
    divergence_sigma_rad: float
    exit_sigma_m: float
    rays_per_beam: int
    range_resolution_m: float
    least_share: float
    min_range_m: float
    max_range_m: float
    noise_m: float
    position_left_m: tuple[float, float, float] = (0.0, -0.06, 0.0)

    def __post_init__(self) -> None:
        """Raise ``ValueError`` for inconsistent parameters."""
        lowest, highest = self.elevation_limits_rad
        violations = {
            "steps are not above 0": not (self.azimuth_step_rad > 0 and self.elevation_step_rad > 0),
            "elevation limits are not two angles from -90 to 90 degrees": not (
                -math.pi / 2 <= lowest <= highest <= math.pi / 2
            ),
            "the beam width is below 0": not (self.divergence_sigma_rad >= 0 and self.exit_sigma_m >= 0),
            "rays_per_beam is not 1 or an even number": self.rays_per_beam != 1
            and (self.rays_per_beam < 2 or self.rays_per_beam % 2 == 1),
            "range_resolution_m is below 0": not self.range_resolution_m >= 0,
            "least_share is not from 0 to 1": not 0 <= self.least_share <= 1,
            "ranges are not 0 < min < max": not 0 < self.min_range_m < self.max_range_m,
            "noise is below 0": not self.noise_m >= 0,
        }
        if any(violations.values()):
            problems = "; ".join(message for message, violated in violations.items() if violated)
            raise ValueError(f"invalid scanner: {problems}: {self}")


SURVEY = ScannerSpec(
    azimuth_step_rad=math.radians(8 * 360.0 / 40960),
    elevation_step_rad=math.radians(8 * 360.0 / 40960),
    elevation_limits_rad=(math.radians(-60.0), math.radians(90.0)),
    divergence_sigma_rad=0.3e-3 / _SIGMAS_PER_1E_WIDTH,
    exit_sigma_m=2.12e-3 / _SIGMAS_PER_1E_WIDTH,
    rays_per_beam=24,
    range_resolution_m=0.3,
    least_share=0.05,
    min_range_m=0.6,
    max_range_m=350.0,
    noise_m=0.3e-3,
)
"""Surveying phase-shift scanner of the class of a FARO Focus S 350.

From a secondary source: divergence 0.3 mrad and 2.12 mm at the exit (both at 1/e), 300 degrees of elevation,
which a public catalogue of scanners quotes from the manufacturer's data sheet. Weaker sources: minimum range 0.6
m, from equipment lists for the older Focus3D X 130 and X 330; maximum range 350 m, from offers. Range resolution:
a quarter of the finest of the modulation wavelengths 1.2, 9.6 and 76 m that the manufacturer's white paper on
phase shift names for its Laser Scanner LS; within that distance the phase of a sum of returns is near their
weighted mean. Not verified, from memory: 0.3 mm of noise at 10 m on a bright surface (used at every range), 40960
points per turn at full resolution, of which every eighth is used (0.07 degrees, about one pixel of the left
camera). Not from any data sheet: ``least_share``, ``rays_per_beam``. The manufacturer's filter of stray points
and systematic range errors are not modelled.
"""

MOBILE = ScannerSpec(
    azimuth_step_rad=math.radians(360.0 / 2048),
    elevation_step_rad=math.radians(45.0 / 127),
    elevation_limits_rad=(math.radians(-22.5), math.radians(22.5)),
    divergence_sigma_rad=math.radians(0.18) / _SIGMAS_PER_FWHM,
    exit_sigma_m=10e-3 / _SIGMAS_PER_FWHM,
    rays_per_beam=60,
    range_resolution_m=1.0,
    least_share=0.05,
    min_range_m=0.8,
    max_range_m=40.0,
    noise_m=15e-3,
)
"""Spinning robot scanner of the class of an Ouster OS1-128 (first generation).

From a copy of its data sheet: 128 beams over 45 degrees, 2048 per turn, divergence 0.18 degrees (full width at
half maximum), 10 mm at the exit, strongest return, 0.8 m to 40 m (10 % surfaces), 1.5 cm of range repeatability
(1 sigma, strong signal). It was not verified that later generations have a smaller minimum range. Not from that
sheet: ``range_resolution_m``, because its "range resolution" of 1.2 cm is interpreted here as that of a single
return; that returns less than 1 m apart can hardly be separated is stated in Livox's note on its own pulsed
sensors (threadlike-noise firmware). Not from any data sheet: ``least_share``, ``rays_per_beam``.
"""


def angles_from_directions(points: Float64[ndarray, "*n 3"]) -> Angles:
    """Return azimuth and elevation of points or directions in the scanner's frame, radians."""
    x, y, z = np.moveaxis(points, -1, 0)
    return np.arctan2(x, z), np.arctan2(-y, np.hypot(x, z))


def directions_from_angles(
    azimuth_rad: Float64[ndarray, "*n"], elevation_rad: Float64[ndarray, "*n"]
) -> Float64[ndarray, "*n 3"]:
    """Return unit directions in the scanner's frame: the inverse of ``angles_from_directions``."""
    cos_elevation = np.cos(elevation_rad)
    return np.stack(
        [np.sin(azimuth_rad) * cos_elevation, -np.sin(elevation_rad), np.cos(azimuth_rad) * cos_elevation], axis=-1
    )


def beam_angles(spec: ScannerSpec, row: Int64[ndarray, " n"], column: Int64[ndarray, " n"]) -> Angles:
    """Return azimuth and elevation of the beams' axes, radians."""
    return (column + 0.5) * spec.azimuth_step_rad, (row + 0.5) * spec.elevation_step_rad


def visible_beams(
    spec: ScannerSpec, rays_left: Float64[ndarray, "h w 3"]
) -> tuple[Int64[ndarray, " n"], Int64[ndarray, " n"]]:
    """Return rows and columns of beams whose cells can contain a pixel of the left image at any measured range.

    ``rays_left`` holds each pixel's ray (x, y, 1) in the left camera's frame. The beams are a block of rows and
    columns, in row-major order. Rows beyond the scanner's elevation limits are excluded; there may be no beam.
    """
    border = np.concatenate([rays_left[0], rays_left[-1], rays_left[:, 0], rays_left[:, -1]])
    near_depth_m = spec.min_range_m / np.linalg.norm(border, axis=1).max()
    directions = np.concatenate([near_depth_m * border - spec.position_left_m, border])
    azimuth, elevation = angles_from_directions(directions)
    columns = np.floor(azimuth / spec.azimuth_step_rad)
    rows = np.floor(elevation / spec.elevation_step_rad)
    lowest, highest = (limit / spec.elevation_step_rad - 0.5 for limit in spec.elevation_limits_rad)
    first_row = max(rows.min(), math.ceil(lowest - _ROUNDING))
    last_row = min(rows.max(), math.floor(highest + _ROUNDING))
    rows, columns = np.arange(first_row, last_row + 1), np.arange(columns.min(), columns.max() + 1)
    row, column = np.meshgrid(rows, columns, indexing="ij")
    return row.ravel().astype(np.int64), column.ravel().astype(np.int64)


def beam_pattern(count: int) -> Float64[ndarray, "r 2"]:
    """Return where sub-rays of equal weight cross a round Gaussian beam, in units of its sigma; deterministic.

    The points are opposite pairs, so that half of the beam has half of the rays. Their radii divide the intensity
    into equal shares, each the root mean square radius of its ring, so that the variance is exactly 1 in each
    direction; their angles advance by the golden ratio. ``count`` is 1 (the axis) or even.
    """
    if count == 1:
        return np.zeros((1, 2))
    pairs = count // 2
    outside = np.linspace(0.0, 1.0, pairs + 1)  # share of the intensity outside a radius: exp(-radius^2 / 2)
    times_log = outside * np.log(np.where(outside > 0, outside, 1.0))
    radius = np.sqrt(2.0 * (1.0 - np.diff(times_log) * pairs))
    angle = np.arange(pairs) * _GOLDEN * math.pi
    half = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.concatenate([half, -half])


def sub_rays(
    spec: ScannerSpec, azimuth_rad: Float64[ndarray, " n"], elevation_rad: Float64[ndarray, " n"]
) -> tuple[Float64[ndarray, "n r 3"], Float64[ndarray, "n r 3"]]:
    """Return origins (metres) and directions of every beam's sub-rays, scanner frame.

    Each ray crosses the exit aperture at a pattern point times the exit sigma and is inclined, perpendicular to
    that offset, by the same point times the divergence sigma. These lines generate the hyperboloid d^2 = d0^2 +
    (divergence * range)^2, so that straight rays reproduce the beam's width at every range.
    """
    pattern = beam_pattern(spec.rays_per_beam)
    rotated = np.stack([-pattern[:, 1], pattern[:, 0]], axis=-1)
    axis = directions_from_angles(azimuth_rad, elevation_rad)[:, None]
    right = directions_from_angles(azimuth_rad + math.pi / 2, np.zeros_like(elevation_rad))[:, None]
    up = directions_from_angles(azimuth_rad, elevation_rad + math.pi / 2)[:, None]
    exit_m, inclination = spec.exit_sigma_m * pattern[..., None], spec.divergence_sigma_rad * rotated[..., None]
    return exit_m[:, 0] * right + exit_m[:, 1] * up, axis + inclination[:, 0] * right + inclination[:, 1] * up


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
    hit_m = np.where(detectable, range_m, np.inf)
    intensity = np.where(detectable, cos_incidence, 0.0)
    moment = intensity * np.where(detectable, range_m, 0.0)
    farthest_m = np.where(detectable, range_m, 0.0).max(axis=1)
    several = farthest_m - hit_m.min(axis=1) > spec.range_resolution_m
    total = intensity.sum(axis=1)
    detected = (total >= spec.least_share * range_m.shape[1]) & (total > 0)
    reported_m = np.where(detected, moment.sum(axis=1) / np.where(detected, total, 1.0), np.nan)
    reported_m[several] = _strongest_return_m(spec, hit_m[several], intensity[several], moment[several])
    return reported_m


def _strongest_return_m(
    spec: ScannerSpec,
    hit_m: Float64[ndarray, "n r"],
    intensity: Float64[ndarray, "n r"],
    moment: Float64[ndarray, "n r"],
) -> Float64[ndarray, " n"]:
    """Return the range of the strongest return of beams that may have several; NaN where none is detected.

    ``hit_m`` holds the ranges of detectable hits (inf: none), ``moment`` their products with the intensity.
    """
    order = np.argsort(hit_m, axis=1, kind="stable")
    hit_m, intensity, moment = (np.take_along_axis(values, order, axis=1) for values in (hit_m, intensity, moment))
    beams, rays = hit_m.shape
    reported_m, highest_total, start_m = np.full(beams, np.nan), np.zeros(beams), np.full(beams, -np.inf)
    total, total_moment = np.zeros(beams), np.zeros(beams)
    for ray in range(rays + 1):
        next_m = hit_m[:, ray] if ray < rays else np.full(beams, np.inf)  # Infinity ends the last return.
        starts_return = next_m > start_m + spec.range_resolution_m
        is_better = starts_return & (total >= spec.least_share * rays) & (total > highest_total)
        reported_m[is_better] = total_moment[is_better] / total[is_better]
        highest_total[is_better] = total[is_better]
        if ray < rays:
            start_m = np.where(starts_return, next_m, start_m)
            total = np.where(starts_return, 0.0, total) + intensity[:, ray]
            total_moment = np.where(starts_return, 0.0, total_moment) + moment[:, ray]
    return reported_m


def simulate_scan(
    caster: RayCaster,
    spec: ScannerSpec,
    row: Int64[ndarray, " n"],
    column: Int64[ndarray, " n"],
    left_cam_from_world: Float64[ndarray, "4 4"],
    view_id: str,
) -> Float64[ndarray, " n"]:
    """Return every beam's reported range, metres, noise included; NaN where no return is detected."""
    lidar_from_world = left_cam_from_world.copy()
    lidar_from_world[:3, 3] -= spec.position_left_m
    world_from_lidar = inverse_rigid(lidar_from_world)
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
    # The seed depends on the view id alone. One number is drawn for every beam, with or without a return, so that
    # a beam's noise does not depend on other beams.
    seed = int.from_bytes(hashlib.sha256(view_id.encode()).digest()[:8], "little")
    return np.asarray(range_m + spec.noise_m * np.random.default_rng(seed).standard_normal(len(row)))
