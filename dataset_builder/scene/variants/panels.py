"""Formwork: two plywood panels on battens, standing on neighbouring sides of the steel.

A slatted screen between the sun and the steel, further off than any camera: it throws stripes of shadow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.model import NOT_STEEL, Mesh, Part
from dataset_builder.scene.shapes.solids import about_z, box, joined, placed
from dataset_builder.scene.variants import SUN_FROM
from dataset_builder.scene.variants.placement import GAP_M, Site

WIDTHS = (0.8, 0.5)
"""The panels' widths, as shares of the side they stand at."""
HEIGHT = 0.75
"""Their height, as a share of the steel's."""
BATTENS = 4


@dataclass(frozen=True)
class _Panel:
    """A panel's measures, metres: how far its inner face is from the steel's middle, and where it is along it."""

    off_m: float
    along_m: float
    width_m: float
    height_m: float
    thickness_m: float


def formwork(site: Site) -> tuple[Part, ...]:
    """Return the panels and their battens; the seed picks the sides."""
    first = int(site.random("formwork").integers(4))
    parts: list[Part] = []
    for n, share in enumerate(WIDTHS):
        side = (first + n) % 4
        panel = _panel(site, side, share, shift=0.25 * n)
        for name, mesh, material in _meshes(panel):
            middle_m = np.array([site.middle_m[0], site.middle_m[1], 0.0])
            parts.append(
                Part(f"formwork-{n}-{name}", placed(mesh, about_z(90.0 * side), middle_m), NOT_STEEL, material)
            )
    return tuple(parts)


def _panel(site: Site, side: int, share: float, shift: float) -> _Panel:
    """Return the panel of one side: 0 stands at +x, and each next one a quarter turn further."""
    across_m, along_m = (site.size_m[0], site.size_m[1]) if side % 2 == 0 else (site.size_m[1], site.size_m[0])
    # Room for spacers and hooks that reach a little beyond the bars' box.
    gap_m = max(0.03 * site.span_m, 3.5 * site.thickest_m)
    return _Panel(
        off_m=float(across_m / 2 + gap_m),
        along_m=float(along_m * share * shift),
        width_m=float(along_m * share),
        height_m=float(max(HEIGHT * site.high_m[2], 0.2 * site.span_m)),
        thickness_m=float(np.clip(0.012 * site.span_m, 0.0012, 0.021)),
    )


def _meshes(panel: _Panel) -> list[tuple[str, Mesh, str]]:
    """Return the sheet, its upright battens and one waler, each clear of the next; the steel is towards -x."""
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
