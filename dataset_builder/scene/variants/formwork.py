"""Formwork of plywood panels: beside the steel, scaled with it, or fitted to a generated cage in real sizes.

Two panels with battens stand on adjacent sides of the steel. Formwork that fits a cage is at the cover along faces
of its bounding box. Its sheets, up to 2.5 m long, are held by studs, walers and, where they are high, raking
struts of timber. Two adjacent sides are closed for a cage that stands or is deep, three for a flat one, which is
seen from above. A cage that is cast lying gets a base, except on the deck, which is one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.model import Mesh, Part, surface
from dataset_builder.scene.shapes.solids import box, rotation_about_z, transformed
from dataset_builder.scene.variants.context import GAP_M, PlacementContext, Rect
from dataset_builder.scene.variants.spacers import LEAST_COVER_M

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


STANDING_COVER_M = 0.04
COVERS_M = (0.025, 0.075)
"""Cover beside a cage that stands, and the range of covers beside one that lies, which are those below it."""
SHEET_M, BASE_M = 0.021, 0.009
"""Thickness of the sheets at the sides and of the base."""
SHEET_LENGTH_M = 2.5
STUD_M = (0.08, 0.06)
WALER_M = (0.06, 0.10)
"""Sections of studs (outwards, along the side) and walers (outwards, upwards)."""
STUD_SPACING_M = 0.5
STRUT_HEIGHT_M = 0.9
"""Height of panels from which they have struts."""
FLAT = 0.35
"""Height of a lying cage per shorter side of its footprint below which it is flat."""
POURED = 0.93
"""Height of the panels beside a cage that stands, as a fraction of the height of its bars: these stick out."""

_TIGHT_M = 0.001
"""Distance between pieces that touch, so that no surfaces coincide."""
_AT_FACE_M = 0.12
"""Distance from a face of the bounding box within which steel decides how high the panel there is."""


@dataclass(frozen=True)
class _Side:
    """Panel of a side in a frame where the steel is towards -x: x of its inner face, ends along y, top; metres."""

    off_m: float
    low_m: float
    high_m: float
    top_m: float


def fitted_formwork(context: PlacementContext) -> tuple[Part, ...]:
    """Return the base and the panels; the seed of the scene selects the sides."""
    is_lying = bool(context.low_m[2] >= LEAST_COVER_M)
    cover_m = _cover_m(context, is_lying=is_lying)
    is_flat = is_lying and context.high_m[2] < FLAT * context.size_m[:2].min()
    first = int(context.rng("formwork").integers(4))
    sides = [(first + n) % 4 for n in range(3 if is_flat else 2)]
    middle_m = context.middle_m * [1, 1, 0]
    parts: list[Part] = []
    for n, side in enumerate(sides):
        rotation = rotation_about_z(90.0 * side)
        panel = _side(context, side, cover_m, is_lying=is_lying, is_last=n == len(sides) - 1)
        parts += [
            surface(f"formwork-{n}-{name}", transformed(mesh, rotation, middle_m), material)
            for name, mesh, material in _fitted_meshes(panel)
        ]
    if is_lying and context.environment != "deck":
        rim_m = cover_m - _TIGHT_M
        low, high = context.low_m[:2] - rim_m, context.high_m[:2] + rim_m
        base = box((float(low[0]), float(low[1]), GAP_M), (float(high[0]), float(high[1]), GAP_M + BASE_M))
        parts.append(surface("formwork-base", base, "plywood"))
    return tuple(parts)


def _cover_m(context: PlacementContext, *, is_lying: bool) -> float:
    """Return the distance of the panels from the bounding box: the cover, or more where spacers need it."""
    cover_m = float(np.clip(context.low_m[2], *COVERS_M)) if is_lying else STANDING_COVER_M
    return max(
        cover_m, *(_overhang_m(context.footprint, rect) + 0.003 for rect in (context.footprint, *context.occupied))
    )


def _overhang_m(inner: Rect, outer: Rect) -> float:
    """Return how far ``outer`` extends beyond ``inner`` on any side, metres."""
    below = max(a - b for a, b in zip(inner.low_m, outer.low_m, strict=True))
    return max(below, *(b - a for a, b in zip(inner.high_m, outer.high_m, strict=True)))


def _side(context: PlacementContext, side: int, cover_m: float, *, is_lying: bool, is_last: bool) -> _Side:
    """Return the panel of a side; side 0 is at +x, the others follow in quarter turns.

    All but the last one reach past the next panel, which ends at their inner face.
    """
    across_m, along_m = context.size_m[[0, 1]] / 2 if side % 2 == 0 else context.size_m[[1, 0]] / 2
    end_m = along_m + cover_m
    steel_m = _top_at_face_m(context, side)
    top_m = steel_m + cover_m if is_lying else POURED * steel_m
    return _Side(
        off_m=float(across_m + cover_m),
        low_m=-float(end_m) + _TIGHT_M,
        high_m=float(end_m) + (-_TIGHT_M if is_last else SHEET_M),
        top_m=float(top_m),
    )


def _top_at_face_m(context: PlacementContext, side: int) -> float:
    """Return the height of the highest steel near a face of the bounding box."""
    axis, sign = side % 2, 1.0 if side < 2 else -1.0
    face_m = context.high_m[axis] if side < 2 else context.low_m[axis]
    capsules = context.capsules
    ends_m = np.concatenate([capsules.a_m, capsules.b_m])
    radius_m = np.concatenate([capsules.radius_m, capsules.radius_m])
    near = sign * (face_m - ends_m[:, axis]) < _AT_FACE_M
    return float((ends_m[near, 2] + radius_m[near]).max(initial=0.1))


def _fitted_meshes(side: _Side) -> list[tuple[str, Mesh, str]]:
    """Return (name, mesh, material) of the pieces of a panel, which do not touch each other."""
    low, high, top = side.low_m, side.high_m, GAP_M + side.top_m
    width_m = high - low
    x, stud, waler = side.off_m, STUD_M[0], WALER_M[0]
    behind_sheet, behind_stud = x + SHEET_M + _TIGHT_M, x + SHEET_M + stud + 2 * _TIGHT_M
    meshes: list[tuple[str, Mesh, str]] = []
    sheets = int(np.ceil(width_m / SHEET_LENGTH_M))
    for k in range(sheets):
        start, end = low + k * width_m / sheets + _TIGHT_M, low + (k + 1) * width_m / sheets - _TIGHT_M
        meshes.append((f"sheet-{k}", box((x, start, GAP_M), (x + SHEET_M, end, top)), "plywood"))
    half = STUD_M[1] / 2
    studs = np.linspace(low + half + 0.01, high - half - 0.01, 2 + int(width_m / STUD_SPACING_M)).tolist()
    for k, y in enumerate(studs):
        foot, head = (behind_sheet, y - half, GAP_M), (behind_sheet + stud, y + half, top - 0.01)
        meshes.append((f"stud-{k}", box(foot, head), "timber"))
    levels_m = _waler_heights_m(side.top_m)
    for k, z in enumerate(levels_m):
        lower, upper = z - WALER_M[1] / 2, z + WALER_M[1] / 2
        meshes.append((f"waler-{k}", box((behind_stud, low, lower), (behind_stud + waler, high, upper)), "timber"))
    if side.top_m > STRUT_HEIGHT_M:
        at = [low + 0.2 * width_m, high - 0.2 * width_m]
        strut = _strut(behind_stud + waler + _TIGHT_M, levels_m[-1])
        meshes += [
            (f"strut-{k}", transformed(strut, np.eye(3), (0.0, y, 0.0)), "timber") for k, y in enumerate(at)
        ]
    return meshes


def _waler_heights_m(top_m: float) -> list[float]:
    """Return the heights of the walers: one in the middle of a low panel, otherwise about 0.8 m apart."""
    if top_m < 0.45:
        return [0.5 * top_m]
    heights: list[float] = np.linspace(0.18, 0.86, max(2, round(top_m / 0.8))).tolist()
    return [share * top_m for share in heights]


def _strut(x_m: float, height_m: float) -> Mesh:
    """Return a raking strut in the plane y = 0 from (``x_m``, ``height_m``) down to the ground beyond it."""
    half, slope = 0.04, np.radians(60.0)
    cosine, sine = float(np.cos(slope)), float(np.sin(slope))
    length_m = (height_m - half * cosine - GAP_M) / sine
    lying = box((0.0, -0.03, -half), (length_m, 0.03, half))
    rotation: Float64[ndarray, "3 3"] = np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
    return transformed(lying, rotation, (x_m + half * sine, 0.0, height_m))
