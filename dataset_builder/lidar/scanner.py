"""Laser scanner model: beam grid, beam shape, returns, range and noise; two instances of real scanner classes.

Reflectivity is not modelled: all surfaces scatter alike (Lambertian). Neither is the decrease of intensity with
the square of range: surfaces mixed in one return are close to each other, and among separate returns the nearer
one is not favoured.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

from jaxtyping import Float64
from numpy import array, eye, ndarray

BeamWidth = Literal["1/e2", "1/e", "fwhm"]
"""Definition of a Gaussian beam's width in a data sheet: the share of the peak intensity at its edge."""

ReturnMode = Literal["strongest", "first"]
"""Which of several returns of one beam a scanner reports."""

SIGMAS_PER_WIDTH: Mapping[BeamWidth, float] = {
    "1/e2": 4.0,
    "1/e": 2.0 * math.sqrt(2.0),
    "fwhm": 2.0 * math.sqrt(2.0 * math.log(2.0)),
}
"""Full widths of the intensity exp(-r^2 / (2 sigma^2)) in sigma.

1/e2 as in ISO 11146 (there d = 4 sigma), 1/e as in IEC 60825-1 (laser safety), fwhm at half of the peak. The same
factors apply to diameters and full angles.
"""

_DEGREE = math.pi / 180.0
"""One degree in radians."""

_DEFAULT_POSITION_LEFT_M = (0.0, -0.06, 0.0)
"""Default position of a scanner: 60 mm above the left camera."""


@dataclass(frozen=True)
class ScannerSpec:
    """Parameters of a scanner whose axes are parallel to the left camera's: x right, y down, z forward.

    - ``azimuth_step_rad``, ``elevation_step_rad``: angle between neighbouring beams; a beam represents a cell of
      this size.
    - ``elevation_limits_rad``: lowest and highest beam, up positive.
    - ``divergence_rad``, ``exit_diameter_m``: full divergence angle and diameter at the exit, both by
      ``beam_width``.
    - ``rays_per_beam``: sub-rays that sample one beam: 1 (its axis) or an even number.
    - ``range_resolution_m``: hits of one beam within this distance behind its nearest surface form one return. It
      should exceed the depth extent of the footprint on slanted surfaces, which otherwise split into weak
      returns.
    - ``reports``: which of several returns of one beam is reported, the ``strongest`` or the ``first`` strong
      enough.
    - ``least_share``: minimum share of the emitted light, at normal incidence, that a return must contain to be
      detected.
    - ``min_range_m``, ``max_range_m``: a surface outside these is not detected, but still occludes.
    - ``noise_m``, ``noise_per_m``: one sigma of a reported range is ``noise_m + noise_per_m * range_m``.
    - ``position_left_m``: the scanner's centre in the left camera's frame, metres.

    Raises ``ValueError`` for inconsistent parameters.
    """

    azimuth_step_rad: float
    elevation_step_rad: float
    elevation_limits_rad: tuple[float, float]
    divergence_rad: float
    exit_diameter_m: float
    beam_width: BeamWidth
    rays_per_beam: int
    range_resolution_m: float
    reports: ReturnMode
    least_share: float
    min_range_m: float
    max_range_m: float
    noise_m: float
    noise_per_m: float = 0.0
    position_left_m: tuple[float, float, float] = _DEFAULT_POSITION_LEFT_M

    def __post_init__(self) -> None:
        """Raise ``ValueError`` for inconsistent parameters."""
        lowest, highest = self.elevation_limits_rad
        violations = {
            "steps are not above 0": not (self.azimuth_step_rad > 0 and self.elevation_step_rad > 0),
            "elevation limits are not two angles from -90 to 90 degrees": not (
                -math.pi / 2 <= lowest <= highest <= math.pi / 2
            ),
            "the beam width is below 0": not (self.divergence_rad >= 0 and self.exit_diameter_m >= 0),
            "rays_per_beam is not 1 or an even number": self.rays_per_beam != 1
            and (self.rays_per_beam < 2 or self.rays_per_beam % 2 == 1),
            "range_resolution_m is below 0": not self.range_resolution_m >= 0,
            "least_share is not from 0 to 1": not 0 <= self.least_share <= 1,
            "ranges are not 0 <= min < max": not 0 <= self.min_range_m < self.max_range_m,
            "noise is below 0": not (self.noise_m >= 0 and self.noise_per_m >= 0),
        }
        if any(violations.values()):
            problems = "; ".join(message for message, violated in violations.items() if violated)
            raise ValueError(f"invalid scanner: {problems}: {self}")

    @property
    def divergence_sigma_rad(self) -> float:
        """One sigma of the sub-rays' angle to the beam's axis, in each direction."""
        return self.divergence_rad / SIGMAS_PER_WIDTH[self.beam_width]

    @property
    def exit_sigma_m(self) -> float:
        """One sigma of the sub-rays' distance from the beam's axis at the exit, in each direction."""
        return self.exit_diameter_m / SIGMAS_PER_WIDTH[self.beam_width]

    @property
    def lidar_from_left(self) -> Float64[ndarray, "4 4"]:
        """Transform from the left camera's frame to the scanner's, metres."""
        pose = eye(4)
        pose[:3, 3] = -array(self.position_left_m)
        return pose

    def to_dict(self) -> dict[str, Any]:
        """Return every parameter as plain JSON values."""
        return asdict(self) | {
            "elevation_limits_rad": list(self.elevation_limits_rad),
            "position_left_m": list(self.position_left_m),
        }


SURVEY = ScannerSpec(
    azimuth_step_rad=8 * 360.0 / 40960 * _DEGREE,
    elevation_step_rad=8 * 360.0 / 40960 * _DEGREE,
    elevation_limits_rad=(-60.0 * _DEGREE, 90.0 * _DEGREE),
    divergence_rad=0.3e-3,
    exit_diameter_m=2.12e-3,
    beam_width="1/e",
    rays_per_beam=24,
    range_resolution_m=0.3,
    reports="strongest",
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
    azimuth_step_rad=360.0 / 2048 * _DEGREE,
    elevation_step_rad=45.0 / 127 * _DEGREE,
    elevation_limits_rad=(-22.5 * _DEGREE, 22.5 * _DEGREE),
    divergence_rad=0.18 * _DEGREE,
    exit_diameter_m=10e-3,
    beam_width="fwhm",
    rays_per_beam=60,
    range_resolution_m=1.0,
    reports="strongest",
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
