"""A slatted screen between the sun and the steel, further off than any camera: it throws stripes of shadow."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.appearance import SUN_FROM
from dataset_builder.appearance.steel_site import GAP_M, Site
from dataset_builder.model import NOT_STEEL, Part
from dataset_builder.shapes.solids import box, joined, placed

DISTANCE = 6.0
"""The screen's plane is this many half diagonals from the steel's middle; cameras stay nearer."""
SLATS = 9
HALF_SIZE = 1.5
"""Half the slatted square's side, in half diagonals."""


def slatted_screen(site: Site) -> tuple[Part, ...]:
    """Return the screen: slats on two rails that lean on down to the ground in the screen's own plane.

    The plane is square to the sun's direction, so that none of it is nearer to the steel than its middle.
    """
    world_from_screen = _axes()
    reach_m = site.reach_m
    middle_m = site.middle_m + DISTANCE * reach_m * world_from_screen[:, 2]
    half_m, pitch_m = HALF_SIZE * reach_m, 2 * HALF_SIZE * reach_m / SLATS
    thick_m = 0.03 * reach_m
    slats = [
        box((-half_m, v_m, 0.0), (half_m, v_m + 0.5 * pitch_m, thick_m))
        for v_m in np.linspace(-half_m, half_m - 0.5 * pitch_m, SLATS)
    ]
    down_m = (middle_m[2] - GAP_M) / world_from_screen[2, 1] - 3 * thick_m
    rails = [
        box((u_m - thick_m, -down_m, 1.1 * thick_m), (u_m + thick_m, half_m + thick_m, 3.1 * thick_m))
        for u_m in (-0.7 * half_m, 0.7 * half_m)
    ]
    return tuple(
        Part(f"screen-{name}", placed(joined(meshes), world_from_screen, middle_m), NOT_STEEL, "timber")
        for name, meshes in (("slats", slats), ("rails", rails))
    )


def _axes() -> Float64[ndarray, "3 3"]:
    """Return the screen's frame as columns: level, up the slope, towards the sun."""
    towards_sun = np.array(SUN_FROM) / np.linalg.norm(SUN_FROM)
    level = np.cross([0.0, 0.0, 1.0], towards_sun)
    level /= np.linalg.norm(level)
    return np.stack([level, np.cross(towards_sun, level), towards_sun], axis=1)
