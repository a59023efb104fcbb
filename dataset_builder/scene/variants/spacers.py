"""Plastic wheel spacers on outer bars: what keeps the cover between steel and formwork."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.model import NOT_STEEL, Mesh, Part
from dataset_builder.scene.shapes.solids import about_z, box, joined, lathe, placed
from dataset_builder.scene.variants.placement import GAP_M, Capsules, Site

BARS_PER_SPACER = 6
FEWEST, MOST = 4, 48
TRIES_PER_BAR = 12
ROUNDS = 4
SPOKES = 6
SAMPLES = 32
"""Points round a wheel at which its clearance is measured."""


@dataclass(frozen=True)
class Wheel:
    """A wheel's measures, metres: bore and rim radius, width along the bar."""

    bore_m: float
    rim_m: float
    width_m: float


def wheel_for(envelope_m: float) -> Wheel:
    """Return the wheel for a bar that stays within ``envelope_m`` of its axis; its bore clears that by 2 %."""
    cover_m = float(np.clip(2.4 * envelope_m, 0.006, 0.04))
    width_m = float(np.clip(1.2 * envelope_m, 0.0025, 0.02))
    return Wheel(1.02 * envelope_m + 1e-4, envelope_m + cover_m, width_m)


def spacers(site: Site) -> tuple[Part, ...]:
    """Return wheels on bars that run along the outside of the steel, where they clear all else.

    Every bar has its turn before any gets a second wheel.
    """
    random = site.random("spacers")
    wanted = int(np.clip(len(site.bars) // BARS_PER_SPACER, FEWEST, MOST))
    taken = np.empty((0, 3))
    parts: list[Part] = []
    for bar in np.tile(random.permutation(len(site.bars)), ROUNDS):
        if len(parts) == wanted:
            break
        found = _place(site, int(bar), taken, random)
        if found is not None:
            wheel, at_m, direction = found
            taken = np.concatenate([taken, at_m[None]])
            mesh = placed(_mesh(wheel), _frame_along(direction), at_m)
            parts.append(Part(f"spacer-{len(parts)}", mesh, NOT_STEEL, "orange plastic"))
    return tuple(parts)


def _place(
    site: Site, bar: int, taken: Float64[ndarray, "k 3"], random: np.random.Generator
) -> tuple[Wheel, Float64[ndarray, " 3"], Float64[ndarray, " 3"]] | None:
    """Return a bar's wheel, where it goes and along what; None where none of some tries is clear."""
    pieces = np.flatnonzero(site.capsules.bar == bar)
    along = site.capsules.b_m[pieces] - site.capsules.a_m[pieces]
    lengths = np.linalg.norm(along, axis=1)
    wheel = wheel_for(float(site.capsules.radius_m[pieces[0]]))
    for _ in range(TRIES_PER_BAR):
        k = int(random.choice(len(pieces), p=lengths / lengths.sum()))
        at_m = site.capsules.a_m[pieces[k]] + random.uniform(0.02, 0.98) * along[k]
        direction = along[k] / lengths[k]
        if lengths[k] < 4 * wheel.width_m or not _outside(site, at_m, wheel):
            continue
        if len(taken) and np.linalg.norm(taken - at_m, axis=1).min() < 3 * wheel.rim_m:
            continue
        if _is_clear(site.capsules, int(pieces[k]), wheel, at_m, direction):
            return wheel, at_m, direction
    return None


def _outside(site: Site, at_m: Float64[ndarray, " 3"], wheel: Wheel) -> bool:
    """Tell whether the wheel would reach beyond the steel's box sideways, and nowhere through the ground."""
    to_side_m = np.minimum(at_m - site.low_m, site.high_m - at_m)[:2].min()
    return bool(to_side_m < wheel.rim_m and at_m[2] - np.hypot(wheel.rim_m, wheel.width_m) > GAP_M)


def _is_clear(
    capsules: Capsules, piece: int, wheel: Wheel, at_m: Float64[ndarray, " 3"], direction: Float64[ndarray, " 3"]
) -> bool:
    """Tell whether the wheel's solid, hub to rim, keeps off every capsule but the piece that it sits on."""
    angle = np.linspace(0.0, 2 * np.pi, SAMPLES, endpoint=False)
    radii = np.linspace(wheel.bore_m, wheel.rim_m, 5)
    heights = np.linspace(-wheel.width_m / 2, wheel.width_m / 2, 3)
    r, a, h = (grid.ravel() for grid in np.meshgrid(radii, angle, heights, indexing="ij"))
    local = np.stack([r * np.cos(a), r * np.sin(a), h], axis=1)
    points_m = local @ _frame_along(direction).T + at_m
    others = capsules.near(points_m.min(axis=0), points_m.max(axis=0))
    others[piece] = False
    # Between samples lies at most half a cell's diagonal.
    cell_m = (2 * np.pi * wheel.rim_m / SAMPLES, radii[1] - radii[0], heights[1] - heights[0])
    return bool(capsules.kept(others).clearance_m(points_m) > np.linalg.norm(cell_m) / 2)


def _mesh(wheel: Wheel) -> Mesh:
    """Return the wheel about the z axis: hub, rim and spokes that end inside both."""
    depth_m = wheel.rim_m - wheel.bore_m
    hub_m, tyre_m, half_m = wheel.bore_m + 0.22 * depth_m, wheel.rim_m - 0.2 * depth_m, wheel.width_m / 2
    spoke = box(
        (hub_m - 0.1 * depth_m, -0.08 * depth_m, -0.8 * half_m),
        (tyre_m + 0.1 * depth_m, 0.08 * depth_m, 0.8 * half_m),
    )
    spokes = [placed(spoke, about_z(360.0 * k / SPOKES), (0.0, 0.0, 0.0)) for k in range(SPOKES)]
    return joined([_ring(wheel.bore_m, hub_m, half_m), _ring(tyre_m, wheel.rim_m, half_m), *spokes])


def _ring(inner_m: float, outer_m: float, half_m: float) -> Mesh:
    # The bore's polygon must not cut into the bar: its sides, not its corners, are at the inner radius.
    inner_m = inner_m / np.cos(np.pi / SAMPLES)
    outline = [(inner_m, -half_m), (outer_m, -half_m), (outer_m, half_m), (inner_m, half_m)]
    return lathe(np.array(outline), SAMPLES)


def _frame_along(direction: Float64[ndarray, " 3"]) -> Float64[ndarray, "3 3"]:
    """Return a rotation that takes z to ``direction``."""
    aside = np.eye(3)[np.argmin(np.abs(direction))]
    x = np.cross(aside, direction)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(direction, x), direction], axis=1)
