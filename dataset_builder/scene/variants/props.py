"""Props of the appearance variants: surfaces around the steel that are not steel.

Props are computed only from the bars and the bounding box of the steel, scale with them, and are reproducible for
a seed. Generated cages are life-size: their formwork and clutter have real sizes, and blocks support those that do
not stand on the ground. The builders run in a fixed order; each receives the ground regions occupied by the
earlier ones. Only supports, tie wire and spacers are placed inside the bounding box of the steel; they stay
outside the envelope of every bar.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from dataset_builder.config.specs import GeneratedCageSpec, SceneSpec
from dataset_builder.scene.model import Assembly, Part
from dataset_builder.scene.variants.clutter import clutter, life_size_clutter
from dataset_builder.scene.variants.fitted_formwork import fitted_formwork
from dataset_builder.scene.variants.panels import formwork, slatted_screen
from dataset_builder.scene.variants.placement import PlacementContext
from dataset_builder.scene.variants.registry import SHADOWS, check_variants
from dataset_builder.scene.variants.spacers import spacers
from dataset_builder.scene.variants.supports import supports
from dataset_builder.scene.variants.tie_wire import tie_wire

PROP_BUILDERS: Mapping[str, Callable[[PlacementContext], tuple[Part, ...]]] = {
    "tie-wire": tie_wire,
    "spacers": spacers,
    "formwork": formwork,
    "clutter": clutter,
    SHADOWS: slatted_screen,
}
"""Prop builders by variant, in execution order, which does not depend on the order of the names in a spec."""

CAGE_PROP_BUILDERS: Mapping[str, Callable[[PlacementContext], tuple[Part, ...]]] = {
    **PROP_BUILDERS,
    "formwork": fitted_formwork,
    "clutter": life_size_clutter,
}
"""Prop builders of generated cages, in the same order."""


def make_props(assembly: Assembly, spec: SceneSpec) -> tuple[Part, ...]:
    """Return the props requested by ``spec.appearance``, and the supports of a generated cage.

    They are in the world frame, all with bar id ``NOT_STEEL``.

    Raises ``InputError`` if the variants do not pass ``check_variants``.
    """
    requested = spec.appearance.variants
    check_variants(requested)
    is_generated = isinstance(spec.assembly, GeneratedCageSpec)
    builders = CAGE_PROP_BUILDERS if is_generated else PROP_BUILDERS
    if not is_generated and not any(name in builders for name in requested):
        return ()
    context = PlacementContext.from_assembly(assembly, spec)
    parts = supports(context) if is_generated else ()
    for name, build_props in builders.items():
        if name in requested:
            props = build_props(context)
            parts = (*parts, *props)
            context = context.with_parts(props)
    return parts
