"""The named variants of a scene's look that a config may ask for; the standard configs use none.

They are what the paper's scenes leave out: other light, other steel, and things that stand in the way.
``AppearanceSpec.variants`` holds their names. Light and steel variants change colour alone; things are real
surfaces of the scene, so that depth and masks take them into account.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from rebar_depth_bench.errors import InputError

LIGHT, STEEL, THINGS = "light", "steel", "things"
EXCLUSIVE_SLOTS = (LIGHT, STEEL)
"""Slots that hold one variant at a time; things add up."""

SHADOWS = "shadows"
SUN_FROM = (-0.53, -0.36, 0.77)
"""Where the sun of ``shadows`` stands as seen from the steel (world axes): its slatted screen hangs there."""


@dataclass(frozen=True)
class Variant:
    """One variant: its name, what it does in words for people, and the slot it fills."""

    name: str
    words: str
    slot: str


_ALL = (
    Variant("dusk", "little light: a dim blue sky and a weak warm glow from one side", LIGHT),
    Variant("spotlight", "one hard lamp in the dark, strong shadows", LIGHT),
    Variant("backlight", "a low strong light from the north (+y), so that views towards it see dark steel", LIGHT),
    Variant(
        SHADOWS, "hard sun through a slatted screen beyond the cameras: stripes of shadow on the steel", LIGHT
    ),
    Variant("mill-scale", "fresh steel: smooth blue-grey scale, hardly any rust", STEEL),
    Variant("rusted", "steel that stood outside for months: rust all over", STEEL),
    Variant("wet", "steel after rain: darker, with a gloss", STEEL),
    Variant(
        "clutter", "buckets, offcuts of timber, boxes, rolls of tape and tools round the steel's foot", THINGS
    ),
    Variant("formwork", "two plywood panels on two sides of the steel, which hide part of it from there", THINGS),
    Variant("spacers", "plastic wheel spacers round some of the outer bars", THINGS),
    Variant("tie-wire", "black wire of 1.2 mm tied round some of the crossings of bars", THINGS),
)
VARIANTS: Mapping[str, Variant] = {variant.name: variant for variant in _ALL}


def check_variants(names: Iterable[str]) -> None:
    """Raise ``InputError`` for unknown names, repeated ones, and two of a slot that holds one."""
    asked = tuple(names)
    unknown = [name for name in dict.fromkeys(asked) if name not in VARIANTS]
    problems = [f"no appearance variant {name!r}, expected one of {', '.join(VARIANTS)}" for name in unknown]
    repeated = [name for name in dict.fromkeys(asked) if asked.count(name) > 1]
    problems += [
        f"appearance variant {name!r} is named {asked.count(name)} times, expected once" for name in repeated
    ]
    for slot in EXCLUSIVE_SLOTS:
        rivals = of_slot(dict.fromkeys(asked), slot)
        if len(rivals) > 1:
            problems.append(f"appearance variants {', '.join(rivals)} all set the {slot}, expected one of them")
    if problems:
        raise InputError("; ".join(problems))


def of_slot(names: Iterable[str], slot: str) -> tuple[str, ...]:
    """Return the known names that fill ``slot``, in their order."""
    return tuple(name for name in names if name in VARIANTS and VARIANTS[name].slot == slot)


def one_of_slot(names: Iterable[str], slot: str) -> str | None:
    """Return the one name that fills an exclusive slot, or None; ``names`` passed ``check_variants``."""
    return next(iter(of_slot(names, slot)), None)
