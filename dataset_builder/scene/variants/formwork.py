"""Formwork of plywood panels: beside the steel, scaled with it, or fitted to a generated cage in real sizes.

Two panels with battens stand on adjacent sides of the steel. Formwork that fits a cage is at the cover along faces
of its bounding box. Its sheets, up to 2.5 m long, are held by studs, walers and, where they are high, raking
struts of timber. Two adjacent sides are closed for a cage that stands or is deep, three for a flat one, which is
seen from above. A cage that is cast lying gets a base, except on the deck, which is one.
The arms of a beam at a standing column rest on falsework, which belongs to the cage and is no variant. Scene files
place sheets of their own. The parts of all sheets have the planes of their faces towards the steel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.cages.design import LEAST_COVER_M
from dataset_builder.scene.model import METRE_DECIMALS, Mesh, Part, surface
from dataset_builder.scene.shapes.solids import Point, box, lathe, merge_meshes, rotation_about_z, transformed
from dataset_builder.scene.variants.context import GAP_M, PlacementContext, Rect
from dataset_builder.scene.variants.spacers import blocks
from dataset_builder.specs.config_specs import FormSpec
from rebar_depth_bench.data.schema import FormPlane

PANEL_WIDTHS = (0.8, 0.5)
"""Widths of the scaled panels, as fractions of the side of the steel at which they stand."""
PANEL_HEIGHT = 0.75
"""Height of the scaled panels, as a fraction of the height of the steel."""
BATTENS = 4
"""Number of battens per scaled panel."""

STANDING_COVER_M = 0.04
COVERS_M = (0.025, 0.075)
"""Cover beside a cage that stands, and the range of covers beside one that lies, which are those below it."""
SHEET_M, BASE_M = 0.021, 0.004
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
class _Panel:
    """Panel of a side in a frame where the steel is towards -x and the side along y; metres.

    ``off_m`` is the x of the inner face, ``ends_m`` are those of the walers along the side, and ``sheets`` the
    ends of the sheets by name. ``posts_m`` are places along the side of posts named ``post``, whose section is
    (outwards, half along the side); ``walers_m`` are heights of walers with the section (outwards, half upwards),
    ``struts_m`` places of struts along the side. Pieces that touch are ``gap_m`` apart.
    """

    off_m: float
    ends_m: tuple[float, float]
    height_m: float
    thickness_m: float
    gap_m: float
    sheets: dict[str, tuple[float, float]]
    post: str
    posts_m: list[float]
    post_section_m: tuple[float, float]
    post_top_m: float
    walers_m: list[float]
    waler_section_m: tuple[float, float]
    struts_m: tuple[float, ...] = ()


def world_from_form(form: FormSpec) -> Float64[ndarray, "3 3"]:
    """Return the axes of a form as columns: along its first side, along the second one, towards the steel."""
    along, normal = np.array(form.along), np.array(form.normal)
    return np.stack([along, np.cross(normal, along), normal], axis=1)


def form_sheet(form: FormSpec) -> Part:
    """Return the sheet of a form of a scene file, ``SHEET_M`` thick behind its face."""
    x, y = form.size_m[0] / 2, form.size_m[1] / 2
    sheet = box((-x, -y, -SHEET_M), (x, y, 0.0))
    plane = FormPlane(name=form.name, point_m=form.point_m, normal=form.normal)
    return surface(f"form-{form.name}", transformed(sheet, world_from_form(form), form.point_m), "plywood", plane)


def _plane(name: str, point_m: Float64[ndarray, " 3"], normal: Float64[ndarray, " 3"]) -> FormPlane:
    """Return a plane, rounded to the picometre: a turn by 90 degrees leaves cosines of 6e-17."""
    (x, y, z), (nx, ny, nz) = (np.round([point_m, normal], METRE_DECIMALS) + 0.0).tolist()  # No -0.0.
    return FormPlane(name=name, point_m=(x, y, z), normal=(nx, ny, nz))


def formwork(context: PlacementContext) -> tuple[Part, ...]:
    """Return the panels, and the base of a generated cage; the seed of the scene selects the sides."""
    first = int(context.rng("formwork").integers(4))
    panels = _fitted_panels(context, first) if context.is_life_size else _scaled_panels(context, first)
    middle_m = context.middle_m * [1, 1, 0]
    parts = []
    for n, (side, panel) in enumerate(panels.items()):
        turn = rotation_about_z(90.0 * side)
        face_m = turn @ [panel.off_m, np.mean(panel.ends_m), GAP_M + panel.height_m / 2] + middle_m
        plane = _plane(f"formwork-{n}", face_m, -turn[:, 0])
        for name, mesh, material in _pieces(panel):
            of_sheet = plane if name in panel.sheets else None
            parts.append(surface(f"formwork-{n}-{name}", transformed(mesh, turn, middle_m), material, of_sheet))
    if context.is_life_size and _is_lying(context) and context.environment != "deck":
        rim_m = _cover_m(context) - _TIGHT_M
        low, high = context.low_m[:2] - rim_m, context.high_m[:2] + rim_m
        base = box((float(low[0]), float(low[1]), GAP_M), (float(high[0]), float(high[1]), GAP_M + BASE_M))
        plane = _plane("formwork-base", np.add(middle_m, [0, 0, GAP_M + BASE_M]), np.array([0.0, 0.0, 1.0]))
        parts.append(surface("formwork-base", base, "plywood", plane))
    return tuple(parts)


def _pieces(panel: _Panel) -> list[tuple[str, Mesh, str]]:
    """Return (name, mesh, material) of the pieces of a panel, which do not touch each other."""
    x, top = panel.off_m, GAP_M + panel.height_m
    (post, half_post), (waler, half_waler) = panel.post_section_m, panel.waler_section_m
    behind_sheet = x + panel.thickness_m + panel.gap_m
    behind_post = x + panel.thickness_m + post + 2 * panel.gap_m
    pieces = [
        (name, box((x, start, GAP_M), (x + panel.thickness_m, end, top)), "plywood")
        for name, (start, end) in panel.sheets.items()
    ]
    for k, y in enumerate(panel.posts_m):
        foot, head = (behind_sheet, y - half_post, GAP_M), (behind_sheet + post, y + half_post, panel.post_top_m)
        pieces.append((f"{panel.post}-{k}", box(foot, head), "timber"))
    low, high = panel.ends_m
    for k, z in enumerate(panel.walers_m):
        beam = box((behind_post, low, z - half_waler), (behind_post + waler, high, z + half_waler))
        pieces.append((f"waler-{k}", beam, "timber"))
    for k, y in enumerate(panel.struts_m):
        strut = _strut(behind_post + waler + panel.gap_m, panel.walers_m[-1])
        pieces.append((f"strut-{k}", transformed(strut, np.eye(3), (0.0, y, 0.0)), "timber"))
    return pieces


def _strut(x_m: float, height_m: float) -> Mesh:
    """Return a raking strut in the plane y = 0 from (``x_m``, ``height_m``) down to the ground beyond it."""
    half, slope = 0.04, np.radians(60.0)
    cosine, sine = float(np.cos(slope)), float(np.sin(slope))
    length_m = (height_m - half * cosine - GAP_M) / sine
    lying = box((0.0, -0.03, -half), (length_m, 0.03, half))
    rotation: Float64[ndarray, "3 3"] = np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
    return transformed(lying, rotation, (x_m + half * sine, 0.0, height_m))


def _across_along_m(context: PlacementContext, side: int) -> tuple[float, float]:
    """Return the sizes of the steel across and along a side: 0 is at +x, the others follow in quarter turns."""
    x_m, y_m, _ = context.size_m.tolist()
    return (x_m, y_m) if side % 2 == 0 else (y_m, x_m)


def _scaled_panels(context: PlacementContext, first: int) -> dict[int, _Panel]:
    """Return two panels by side, from the side ``first`` on, the second at one end of its side."""
    # Leave room for spacers and hooks, which extend beyond the bounding box of the bars.
    gap_m = max(0.03 * context.span_m, 3.5 * context.thickest_m)
    height_m = float(max(PANEL_HEIGHT * context.high_m[2], 0.2 * context.span_m))
    thickness_m = float(np.clip(0.012 * context.span_m, 0.0012, 0.021))
    panels = {}
    for n, share in enumerate(PANEL_WIDTHS):
        side = (first + n) % 4
        across_m, along_m = _across_along_m(context, side)
        width_m = along_m * share
        middle_m = along_m * share * (0.25 * n)
        low_m, high_m = middle_m - width_m / 2, middle_m + width_m / 2
        half_m = min(1.8 * thickness_m, 0.08 * width_m)
        panels[side] = _Panel(
            off_m=across_m / 2 + gap_m,
            ends_m=(low_m, high_m),
            height_m=height_m,
            thickness_m=thickness_m,
            gap_m=thickness_m * 0.05,
            sheets={"sheet": (low_m, high_m)},
            post="batten",
            posts_m=np.linspace(low_m + 2 * half_m, high_m - 2 * half_m, BATTENS).tolist(),
            post_section_m=(2.5 * thickness_m, half_m),
            post_top_m=GAP_M + height_m - 0.02 * height_m,
            walers_m=[0.25 * height_m, 0.75 * height_m],
            waler_section_m=(2.5 * thickness_m, half_m),
        )
    return panels


def _fitted_panels(context: PlacementContext, first: int) -> dict[int, _Panel]:
    """Return the panels of a generated cage by side, from the side ``first`` on.

    All but the last one reach past the next panel, which ends at their inner face.
    """
    cover_m = _cover_m(context)
    is_flat = _is_lying(context) and context.high_m[2] < FLAT * context.size_m[:2].min()
    sides = [(first + n) % 4 for n in range(3 if is_flat else 2)]
    panels = {}
    for side in sides:
        across_m, along_m = _across_along_m(context, side)
        end_m = along_m / 2 + cover_m
        low_m = -end_m + _TIGHT_M
        high_m = end_m + (-_TIGHT_M if side == sides[-1] else SHEET_M)
        width_m = high_m - low_m
        count = int(np.ceil(width_m / SHEET_LENGTH_M))
        joints_m = [low_m + k * width_m / count for k in range(count + 1)]
        steel_m = _top_at_face_m(context, side)
        height_m = steel_m + cover_m if _is_lying(context) else POURED * steel_m
        half_m = STUD_M[1] / 2
        studs = 2 + int(width_m / STUD_SPACING_M)
        panels[side] = _Panel(
            off_m=across_m / 2 + cover_m,
            ends_m=(low_m, high_m),
            height_m=height_m,
            thickness_m=SHEET_M,
            gap_m=_TIGHT_M,
            sheets={f"sheet-{k}": (joints_m[k] + _TIGHT_M, joints_m[k + 1] - _TIGHT_M) for k in range(count)},
            post="stud",
            posts_m=np.linspace(low_m + half_m + 0.01, high_m - half_m - 0.01, studs).tolist(),
            post_section_m=(STUD_M[0], half_m),
            post_top_m=GAP_M + height_m - 0.01,
            walers_m=_waler_heights_m(height_m),
            waler_section_m=(WALER_M[0], WALER_M[1] / 2),
            struts_m=(low_m + 0.2 * width_m, high_m - 0.2 * width_m) if height_m > STRUT_HEIGHT_M else (),
        )
    return panels


def _is_lying(context: PlacementContext) -> bool:
    """Return whether a generated cage lies on spacers."""
    return bool(context.low_m[2] >= LEAST_COVER_M)


def _cover_m(context: PlacementContext) -> float:
    """Return the distance of the panels from the bounding box: the cover, or more where spacers need it."""
    cover_m = float(np.clip(context.low_m[2], *COVERS_M)) if _is_lying(context) else STANDING_COVER_M
    return max(
        cover_m, *(_overhang_m(context.footprint, rect) + 0.003 for rect in (context.footprint, *context.occupied))
    )


def _overhang_m(inner: Rect, outer: Rect) -> float:
    """Return how far ``outer`` extends beyond ``inner`` on any side, metres."""
    return float(max((inner.low_m - outer.low_m).max(), (outer.high_m - inner.high_m).max()))


def _top_at_face_m(context: PlacementContext, side: int) -> float:
    """Return the height of the highest steel near a face of the bounding box."""
    axis, sign = side % 2, 1.0 if side < 2 else -1.0
    face_m = context.high_m[axis] if side < 2 else context.low_m[axis]
    capsules = context.capsules
    ends_m = np.concatenate([capsules.a_m, capsules.b_m])
    radius_m = np.concatenate([capsules.radius_m, capsules.radius_m])
    near = sign * (face_m - ends_m[:, axis]) < _AT_FACE_M
    return float((ends_m[near, 2] + radius_m[near]).max(initial=0.1))


def _waler_heights_m(top_m: float) -> list[float]:
    """Return the heights of the walers: one in the middle of a low panel, otherwise about 0.8 m apart."""
    if top_m < 0.45:
        return [0.5 * top_m]
    heights: list[float] = np.linspace(0.18, 0.86, max(2, round(top_m / 0.8))).tolist()
    return [share * top_m for share in heights]


SOFFIT_COVER_M, ARM_START_M, ARM_FROM_M = 0.035, 0.11, 0.3
"""Distance of a soffit from the steel above it; start of an arm beyond a column's feet, and its least length."""
JOIST_M, BEARER_M, BEARER_END_M = (0.06, 0.10), (0.08, 0.12), 0.12
"""Sections (width, height) of timbers along and across a soffit, and the length of the latter beyond it."""


def falsework(context: PlacementContext) -> tuple[Part, ...]:
    """Return soffits with blocks, on timbers and props, below the arms, along x, of a cage that stands."""
    if _is_lying(context):
        return ()
    capsules, parts = context.capsules, list[Part]()
    ends_m = np.concatenate([capsules.a_m, capsules.b_m])
    radius_m = np.concatenate([capsules.radius_m, capsules.radius_m])[:, None]
    is_foot = (ends_m - radius_m)[:, 2] < LEAST_COVER_M
    for sign in (-1.0, 1.0):
        reach_m = sign * ends_m[:, 0]
        start_m = float(reach_m[is_foot].max()) + ARM_START_M
        if reach_m.max() > start_m + ARM_FROM_M:
            arm = reach_m > start_m
            low_m, high_m = (ends_m - radius_m)[arm].min(axis=0), (ends_m + radius_m)[arm].max(axis=0)
            (low_m if sign > 0 else high_m)[0] = sign * start_m
            soffit_m = float(low_m[2]) - SOFFIT_COVER_M
            name = f"falsework-{len(parts)}"
            parts += _soffit(name, Rect(low_m[:2], high_m[:2]).expanded(SOFFIT_COVER_M), soffit_m)
            parts += blocks(f"{name}-blocks", context, low_m, high_m, soffit_m + _TIGHT_M)
    return tuple(parts)


def _soffit(name: str, rect: Rect, top_m: float) -> tuple[Part, ...]:
    """Return a sheet with its upper face at ``top_m``, and what carries it."""
    (x, y), (end_x, end_y) = rect.low_m.tolist(), rect.high_m.tolist()
    joist_m = top_m - SHEET_M - _TIGHT_M
    bearer_m = joist_m - JOIST_M[1] - _TIGHT_M
    prop_m = bearer_m - BEARER_M[1] - _TIGHT_M - GAP_M
    sheet = box((x, y, top_m - SHEET_M), (end_x, end_y, top_m))
    low_m, props = joist_m - JOIST_M[1], []
    timbers = [box((x, at, low_m), (end_x, at + JOIST_M[0], joist_m)) for at in (y, end_y - JOIST_M[0])]
    for at in (0.85 * x + 0.15 * end_x, 0.15 * x + 0.85 * end_x):
        low = (at - BEARER_M[0] / 2, y - BEARER_END_M, bearer_m - BEARER_M[1])
        timbers.append(box(low, (at + BEARER_M[0] / 2, end_y + BEARER_END_M, bearer_m)))
        props += [_prop((at, side, GAP_M), prop_m) for side in (y - BEARER_END_M / 2, end_y + BEARER_END_M / 2)]
    plane = _plane(name, np.array([(x + end_x) / 2, (y + end_y) / 2, top_m]), np.array([0.0, 0.0, 1.0]))
    return (
        surface(f"{name}-sheet", sheet, "plywood", plane),
        surface(f"{name}-timbers", merge_meshes(timbers), "timber"),
        surface(f"{name}-props", merge_meshes(props), "red paint"),
    )


def _prop(foot_m: Point, height_m: float) -> Mesh:
    """Return a steel prop: a plate, a tube, and a thinner tube with a plate."""
    middle_m, head_m = 0.6 * height_m, height_m - 0.008
    outline = [(0.001, 0.0), (0.07, 0.0), (0.07, 0.008), (0.03, 0.008), (0.03, middle_m), (0.024, middle_m)]
    outline += [(0.024, head_m), (0.06, head_m), (0.06, height_m), (0.001, height_m)]
    return transformed(lathe(np.array(outline)), np.eye(3), foot_m)
