"""The things of a scene's appearance variants: real surfaces round the steel, none of them steel.

They are made from the bars and the bounding box alone, scale with them, and repeat for the same seed. Makers
run in a fixed order, each told what ground the earlier ones took; nothing stands in the steel's bounding box
but tie wire and spacers, which keep clear of every bar's envelope.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from dataset_builder.config.specs import SceneSpec
from dataset_builder.scene.model import Assembly, Part
from dataset_builder.scene.variants import SHADOWS, check_variants
from dataset_builder.scene.variants.clutter import clutter
from dataset_builder.scene.variants.panels import formwork, slatted_screen
from dataset_builder.scene.variants.placement import Site
from dataset_builder.scene.variants.spacers import spacers
from dataset_builder.scene.variants.tie_wire import tie_wire

MAKERS: Mapping[str, Callable[[Site], tuple[Part, ...]]] = {
    "tie-wire": tie_wire,
    "spacers": spacers,
    "formwork": formwork,
    "clutter": clutter,
    SHADOWS: slatted_screen,
}
"""By variant, in the order in which they run, whatever the order of the names in a spec."""


def occluders(assembly: Assembly, spec: SceneSpec) -> tuple[Part, ...]:
    """Return the things that ``spec.appearance`` asks for, in the world frame, all with id ``NOT_STEEL``.

    Raises ``InputError`` where the variants' names do not pass ``check_variants``.
    """
    asked = spec.appearance.variants
    check_variants(asked)
    parts: tuple[Part, ...] = ()
    if not any(name in MAKERS for name in asked):
        return parts
    site = Site.of(assembly, spec)
    for name, make in MAKERS.items():
        if name in asked:
            made = make(site)
            parts = (*parts, *made)
            site = site.with_parts(made)
    return parts
