"""Props of the appearance variants: surfaces around the steel that are not steel.

Props are computed only from the bars and the bounding box of the steel, scale with them, and are reproducible for
a seed. Generated cages are life-size: their formwork and clutter have real sizes; blocks support those that do not
stand on the ground, and falsework the arms of beams. The builders run in a fixed order; each receives the ground
regions occupied by the earlier ones. Only supports, tie wire and spacers are placed inside the bounding box of the
steel; they stay outside the envelope of every bar.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.environments.surroundings import SURROUNDINGS, floor_offset_m
from dataset_builder.scene.model import Assembly, Part, surface
from dataset_builder.scene.shapes.solids import box, merge_meshes, transformed
from dataset_builder.scene.variants.clutter import clutter
from dataset_builder.scene.variants.context import GAP_M, PlacementContext
from dataset_builder.scene.variants.formwork import falsework, form_sheet, formwork
from dataset_builder.scene.variants.registry import SCREEN_DISTANCE, SHADOWS, SUN_FROM
from dataset_builder.scene.variants.spacers import spacers, supports
from dataset_builder.scene.variants.tie_wire import tie_wire
from dataset_builder.specs.config_specs import SceneSpec
from rebar_depth_bench.data.schema import FormPlane

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


PROP_BUILDERS: Mapping[str, Callable[[PlacementContext], tuple[Part, ...]]] = {
    "tie-wire": tie_wire,
    "spacers": spacers,
    "formwork": formwork,
    "clutter": clutter,
    SHADOWS: slatted_screen,
}
"""Prop builders by variant, in execution order, which does not depend on the order of the names in a spec."""


def make_props(assembly: Assembly, spec: SceneSpec) -> tuple[Part, ...]:
    """Return the sheets of ``spec.forms``, the props of its ``appearance``, and what carries a generated cage.

    They are in the world frame, all with bar id ``NOT_STEEL``.
    """
    context = PlacementContext.from_assembly(assembly, spec)
    parts = tuple(form_sheet(form) for form in spec.forms)
    parts += (*supports(context), *falsework(context)) if context.is_life_size else ()
    context = context.with_parts(parts)
    for name, build_props in PROP_BUILDERS.items():
        if name in spec.appearance.variants:
            props = build_props(context)
            parts = (*parts, *props)
            context = context.with_parts(props)
    return parts


def form_planes(scene: SceneSpec, props: Iterable[Part]) -> tuple[FormPlane, ...]:
    """Return the planes of formwork that the surroundings of a scene and its ``props`` show, each once."""
    offset_m = np.array([0.0, 0.0, floor_offset_m(scene)])
    of_surroundings = [
        plane.model_copy(update={"point_m": tuple((plane.point_m + offset_m).tolist())})
        for plane in SURROUNDINGS[scene.environment].planes
    ]
    of_props = (part.plane for part in props if part.plane is not None)
    return tuple(dict.fromkeys((*of_surroundings, *of_props)))
