"""Surroundings of the steel by environment: surfaces, lights, space for cameras and steel, suitable variants.

A new environment is a module in ``dataset_builder.scene.environments`` with its surfaces, a table of lights in
``light_rigs`` beside it, and an entry of ``SURROUNDINGS``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from dataset_builder.scene.environments import hall, laboratory
from dataset_builder.scene.environments.deck import deck
from dataset_builder.scene.environments.light_rigs import (
    DECK_LIGHT,
    HALL_LIGHT,
    LABORATORY_LIGHT,
    OUTDOOR_LIGHT,
    LightRig,
)
from dataset_builder.scene.environments.outdoors import outdoors
from dataset_builder.scene.model import Part
from dataset_builder.scene.variants.registry import IMAGE_LIGHTS, LIGHT_SLOT, VARIANTS
from dataset_builder.specs.config_specs import SceneSpec
from rebar_depth_bench.base.errors import InputError, Problem
from rebar_depth_bench.data.schema import FormPlane

GROUND_CLEARANCE_M = 0.1
"""Least height of an eye above the ground, or above objects that stand there, metres."""


@dataclass(frozen=True)
class CameraSpace:
    """Space for cameras: within ``radius_m`` of the origin in plan, above the ground, not above ``ceiling_m``.

    Objects up to ``objects_m`` high stand on the ground beyond ``clear_radius_m``.
    """

    radius_m: float
    clear_radius_m: float
    objects_m: float = 0.0
    ceiling_m: float = np.inf

    def contains(self, points_m: Float64[ndarray, "n 3"]) -> Bool[ndarray, " n"]:
        """Return which points are in the space."""
        plan_m = np.hypot(points_m[:, 0], points_m[:, 1])
        lowest_m = GROUND_CLEARANCE_M + np.where(plan_m > self.clear_radius_m, self.objects_m, 0.0)
        is_between = (points_m[:, 2] >= lowest_m) & (points_m[:, 2] <= self.ceiling_m)
        return np.asarray((plan_m <= self.radius_m) & is_between)


@dataclass(frozen=True)
class Surroundings:
    """Surroundings of an environment: surfaces (world, none is steel), lights, and space for cameras and steel.

    ``light`` has the lights by light variant, None for the default. ``steel_radius_m`` is the space for steel in
    plan, ``floor_m`` the height of the surface that a board lies on, and ``markers`` the default number of markers
    of a board, 0 for no board. ``enclosure`` and ``roof`` are the first words of the names of surfaces that would
    keep out the light of a panorama, and that of any sky or lamp. ``planes`` are those of formwork.
    """

    parts: Callable[[], tuple[Part, ...]]
    light: Mapping[str | None, LightRig]
    cameras: CameraSpace
    steel_radius_m: float
    enclosure: tuple[str, ...]
    roof: tuple[str, ...] = ()
    floor_m: float = 0.0
    markers: int = 0
    planes: tuple[FormPlane, ...] = ()

    def suits(self, variant: str) -> bool:
        """Return whether a variant can be built there: not a light variant without an entry in ``light``."""
        return VARIANTS[variant].slot != LIGHT_SLOT or variant in self.light or variant in IMAGE_LIGHTS

    def variants(self, slot: str) -> tuple[str, ...]:
        """Return the names of the variants of a slot that suit the environment."""
        return tuple(name for name, variant in VARIANTS.items() if variant.slot == slot and self.suits(name))


SURROUNDINGS: Mapping[str, Surroundings] = {
    "laboratory": Surroundings(
        laboratory.laboratory,
        LABORATORY_LIGHT,
        CameraSpace(1.6, clear_radius_m=0.6, objects_m=0.2),
        steel_radius_m=0.45,
        enclosure=laboratory.WALLS,
        floor_m=laboratory.BENCH_TOP_M,
        markers=6,
    ),
    "outdoors": Surroundings(
        outdoors, OUTDOOR_LIGHT, CameraSpace(20.5, clear_radius_m=20.5), steel_radius_m=20.5, enclosure=("trees",)
    ),
    "hall": Surroundings(
        hall.hall,
        HALL_LIGHT,
        CameraSpace(10.4, clear_radius_m=10.4, ceiling_m=6.8),
        steel_radius_m=5.0,
        enclosure=hall.WALLS,
        roof=hall.ROOF,
    ),
    "deck": Surroundings(
        deck,
        DECK_LIGHT,
        CameraSpace(8.3, clear_radius_m=8.3, ceiling_m=8.0),
        steel_radius_m=5.0,
        enclosure=("trees", "hills", "core"),
        planes=(FormPlane(name="deck", point_m=(0.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0)),),
    ),
}
"""Surroundings by the name of their environment.

In the laboratory, objects lie on the bench beyond the radius of the steel, and furniture stands beyond that of the
cameras. The others are clear within the radius of the cameras; the slatted screen of ``shadows`` needs more room
than the hall and the deck have.
"""

LIFE_SIZE_ENVIRONMENTS = ("outdoors", "hall", "deck")
"""Environments with room for life-size cages and cameras up to 8 m from them; on the deck, up to its rim."""

FORMWORK_FAMILIES = ("beam", "wall", "slab", "footing")
"""Families of generated cages that ``formwork`` suits: others are round, or cast in the ground or in stages."""


def floor_offset_m(scene: SceneSpec) -> float:
    """Return the height of the surroundings: a floor at z = 0, which would coincide with a board, is lowered."""
    floor_m = SURROUNDINGS[scene.environment].floor_m
    return 0.0 if scene.board is None else min(0.0, laboratory.BENCH_TOP_M - floor_m)


def check_suitable(environment: str, variants: Iterable[str]) -> None:
    """Raise ``InputError`` that lists the variants which cannot be built in an environment."""
    problems = [
        Problem(
            "conflict",
            repr(name),
            f"cannot be built in the environment {environment}",
            f"another variant, or an environment out of {', '.join(_environments_of(name))}",
        )
        for name in variants
        if not SURROUNDINGS[environment].suits(name)
    ]
    if problems:
        raise InputError.from_problems("appearance variants", problems)


def _environments_of(variant: str) -> list[str]:
    return [name for name, surroundings in SURROUNDINGS.items() if surroundings.suits(variant)]
