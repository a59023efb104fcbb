"""Formwork: two plywood panels on battens, standing on neighbouring sides of the steel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dataset_builder.appearance.steel_site import GAP_M, Site
from dataset_builder.model import NOT_STEEL, Mesh, Part
from dataset_builder.shapes.solids import about_z, box, placed

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
