"""Panel props: formwork beside the steel, and a slatted screen that casts stripes of shadow on it.

The formwork consists of two plywood panels with battens on adjacent sides of the steel. The slatted screen is
between the sun and the steel, farther away than any camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.model import Mesh, Part, surface
from dataset_builder.scene.shapes.solids import box, merge_meshes, rotation_about_z, transformed
from dataset_builder.scene.variants.placement import GAP_M, PlacementContext
from dataset_builder.scene.variants.registry import SUN_FROM

PANEL_WIDTHS = (0.8, 0.5)
"""Widths of the panels, as fractions of the side of the steel at which they stand."""
PANEL_HEIGHT = 0.75
"""Height of the panels, as a fraction of the height of the steel."""
BATTENS = 4
"""Number of battens per panel."""


@dataclass(frozen=True)
class _Panel:
    """Dimensions of a panel, metres.

    ``off_m`` is the distance of its inner face from the centre of the steel, ``along_m`` the offset of its centre
    along the side.
    """

    off_m: float
    along_m: float
    width_m: float
    height_m: float
    thickness_m: float


def formwork(context: PlacementContext) -> tuple[Part, ...]:
    """Return the panels and their battens; the seed of the scene selects the sides."""
    first = int(context.rng("formwork").integers(4))
    middle_m = context.middle_m * [1, 1, 0]
    parts: list[Part] = []
    for n, share in enumerate(PANEL_WIDTHS):
        side = (first + n) % 4
        rotation = rotation_about_z(90.0 * side)
        for name, mesh, material in _panel_meshes(_panel(context, side, share, shift=0.25 * n)):
            parts.append(surface(f"formwork-{n}-{name}", transformed(mesh, rotation, middle_m), material))
    return tuple(parts)


def _panel(context: PlacementContext, side: int, share: float, shift: float) -> _Panel:
    """Return the panel of one side; side 0 is at +x, the others follow in quarter turns.

    ``share`` is the width and ``shift`` the offset, both as fractions: of the side and of the width.
    """
    across_m, along_m = (
        (context.size_m[0], context.size_m[1]) if side % 2 == 0 else (context.size_m[1], context.size_m[0])
    )
    # Leave room for spacers and hooks, which extend beyond the bounding box of the bars.
    gap_m = max(0.03 * context.span_m, 3.5 * context.thickest_m)
    return _Panel(
        off_m=float(across_m / 2 + gap_m),
        along_m=float(along_m * share * shift),
        width_m=float(along_m * share),
        height_m=float(max(PANEL_HEIGHT * context.high_m[2], 0.2 * context.span_m)),
        thickness_m=float(np.clip(0.012 * context.span_m, 0.0012, 0.021)),
    )


def _panel_meshes(panel: _Panel) -> list[tuple[str, Mesh, str]]:
    """Return (name, mesh, material) of the sheet, its battens and its walers; the steel is towards -x.

    The pieces do not touch each other.
    """
    x, t, gap = panel.off_m, panel.thickness_m, panel.thickness_m * 0.05
    low, high = panel.along_m - panel.width_m / 2, panel.along_m + panel.width_m / 2
    depth = 2.5 * t
    x_batten, x_waler = x + t + gap, x + t + depth + 2 * gap
    half = min(1.8 * t, 0.08 * panel.width_m)
    at = np.linspace(low + 2 * half, high - 2 * half, BATTENS)
    top = GAP_M + panel.height_m
    meshes = [("sheet", box((x, low, GAP_M), (x + t, high, top)), "plywood")]
    for k, y in enumerate(at):
        batten = box((x_batten, y - half, GAP_M), (x_batten + depth, y + half, top - 0.02 * panel.height_m))
        meshes.append((f"batten-{k}", batten, "timber"))
    for k, share in enumerate((0.25, 0.75)):
        z = share * panel.height_m
        waler = box((x_waler, low, z - half), (x_waler + depth, high, z + half))
        meshes.append((f"waler-{k}", waler, "timber"))
    return meshes


SCREEN_DISTANCE = 6.0
"""Distance of the screen from the centre of the steel, in half diagonals of the steel; cameras are nearer."""
SLATS = 9
"""Number of slats of the screen."""
SCREEN_HALF_SIZE = 1.5
"""Half the side of the square screen, in half diagonals of the steel."""


def slatted_screen(context: PlacementContext) -> tuple[Part, ...]:
    """Return the screen: slats on two rails that extend to the ground in the plane of the screen.

    The plane is perpendicular to the direction of the sun, so its centre is its point nearest to the steel.
    """
    world_from_screen = _world_from_screen()
    reach_m = context.reach_m
    middle_m = context.middle_m + SCREEN_DISTANCE * reach_m * world_from_screen[:, 2]
    half_m, pitch_m = SCREEN_HALF_SIZE * reach_m, 2 * SCREEN_HALF_SIZE * reach_m / SLATS
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
        surface(f"screen-{name}", transformed(merge_meshes(meshes), world_from_screen, middle_m), "timber")
        for name, meshes in (("slats", slats), ("rails", rails))
    )


def _world_from_screen() -> Float64[ndarray, "3 3"]:
    """Return the axes of the screen as columns: horizontal, up the slope, towards the sun."""
    towards_sun = np.array(SUN_FROM) / np.linalg.norm(SUN_FROM)
    horizontal = np.cross([0.0, 0.0, 1.0], towards_sun)
    horizontal /= np.linalg.norm(horizontal)
    return np.stack([horizontal, np.cross(towards_sun, horizontal), towards_sun], axis=1)
