"""Camera protocols: where the left camera of the rig stands, view by view. World frame, metres."""

from __future__ import annotations

from math import cos, radians, sin

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.config.specs import ProtocolSpec, RigSpec, RingSpec, SweepSpec
from rebar_depth_bench.geometry.cameras import look_at, rigid

GOLDEN_TURN_DEG = 360.0 * (5**0.5 - 1) / 2
"""Each ring of a dome starts this much further round, so that no two rings repeat each other's azimuths."""


def poses(protocol: ProtocolSpec, target_m: Float64[ndarray, 3], rig: RigSpec) -> list[Float64[ndarray, "4 4"]]:
    """Return the left camera's ``cam_from_world`` of every view of the full protocol, in order."""
    return [aim_rig(target_m + direction, target_m, rig.baseline_m) for direction in offsets_m(protocol)]


def offsets_m(protocol: ProtocolSpec) -> list[Float64[ndarray, 3]]:
    """Return the left camera's centre relative to the target, view by view.

    A dome runs shell by shell, ring by ring, azimuth by azimuth: neighbours in order are neighbours in space.
    A sweep runs from distance to distance and starts half a step off the x axis: square cages are seen askew.
    """
    if isinstance(protocol, RingSpec):
        return [
            _spherical(protocol.radius_m, protocol.elevation_deg, 360.0 * k / protocol.azimuths)
            for k in range(protocol.azimuths)
        ]
    if isinstance(protocol, SweepSpec):
        return [
            _spherical(radius_m, protocol.elevation_deg, 360.0 * (k + 0.5) / protocol.azimuths)
            for radius_m in protocol.radii_m
            for k in range(protocol.azimuths)
        ]
    rings = [(radius_m, elevation) for radius_m in protocol.radii_m for elevation in protocol.elevations_deg]
    return [
        _spherical(radius_m, elevation, GOLDEN_TURN_DEG * ring + 360.0 * k / protocol.azimuths)
        for ring, (radius_m, elevation) in enumerate(rings)
        for k in range(protocol.azimuths)
    ]


def aim_rig(
    left_centre_m: Float64[ndarray, 3], target_m: Float64[ndarray, 3], baseline_m: float
) -> Float64[ndarray, "4 4"]:
    """Return ``cam_from_world`` of a left camera whose rig, not whose own axis, looks at the target.

    The rig's middle axis passes through the target, which so lies at x = baseline / 2 in the left camera and
    at -baseline / 2 in the right one: both eyes keep the assembly in frame at arm's length.
    """
    towards = look_at(left_centre_m, target_m)
    distance_m = float(np.linalg.norm(target_m - left_centre_m))
    sine = baseline_m / 2 / distance_m
    cosine = (1.0 - sine * sine) ** 0.5
    yaw = np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
    return np.asarray(rigid(yaw, np.zeros(3)) @ towards)


def subset(total: int, wanted: int | None) -> list[int]:
    """Return the indices of ``wanted`` views spread evenly over ``total``: the middles of equal stretches."""
    if wanted is None or wanted >= total:
        return list(range(total))
    return [(2 * i + 1) * total // (2 * wanted) for i in range(wanted)]


def _spherical(radius_m: float, elevation_deg: float, azimuth_deg: float) -> Float64[ndarray, 3]:
    elevation, azimuth = radians(elevation_deg), radians(azimuth_deg)
    level = cos(elevation)
    return np.array([radius_m * level * cos(azimuth), radius_m * level * sin(azimuth), radius_m * sin(elevation)])
