"""Surroundings of the steel by environment: space for cameras and steel, and the variants that suit them.

The surfaces of the environments are in ``dataset_builder.scene.environments``, their lights in
``dataset_builder.blender.lights``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from dataset_builder.config.camera_site import CameraSpace
from dataset_builder.scene.variants.registry import SHADOWS, VARIANTS
from rebar_depth_bench.errors import InputError, Problem


@dataclass(frozen=True)
class Surroundings:
    """Surroundings of an environment: the space for cameras, and ``steel_radius_m``, that for steel in plan.

    ``markers`` is the default number of markers on a board, 0 for no board. The ``unsuitable`` variants cannot be
    built there.
    """

    cameras: CameraSpace
    steel_radius_m: float
    markers: int = 0
    unsuitable: tuple[str, ...] = ()

    def variants(self, slot: str) -> tuple[str, ...]:
        """Return the names of the variants of a slot that suit the environment."""
        return tuple(
            name for name, variant in VARIANTS.items() if variant.slot == slot and name not in self.unsuitable
        )


LABORATORY_CAMERAS = CameraSpace(1.6, clear_radius_m=0.6, objects_m=0.2)
OUTDOOR_CAMERAS = CameraSpace(20.5, clear_radius_m=20.5)
HALL_CAMERAS = CameraSpace(10.4, clear_radius_m=10.4, ceiling_m=6.8)
DECK_CAMERAS = CameraSpace(8.3, clear_radius_m=8.3, ceiling_m=8.0)

SURROUNDINGS: Mapping[str, Surroundings] = {
    "laboratory": Surroundings(LABORATORY_CAMERAS, 0.45, markers=6),
    "outdoors": Surroundings(OUTDOOR_CAMERAS, 20.5),
    "hall": Surroundings(HALL_CAMERAS, 5.0, unsuitable=(SHADOWS,)),
    "deck": Surroundings(DECK_CAMERAS, 5.0, unsuitable=(SHADOWS,)),
}
"""Surroundings by the name of their environment.

In the laboratory, objects lie on the bench beyond the radius of the steel, and furniture stands beyond that of the
cameras. The others are clear within the radius of the cameras; the slatted screen of ``shadows`` needs more room
than the hall and the deck have.
"""

LIFE_SIZE_ENVIRONMENTS = ("outdoors", "hall", "deck")
"""Environments with room for life-size cages and cameras up to 8 m from them; on the deck, up to its rim."""

FORMWORK_FAMILIES = ("column", "beam", "wall", "slab", "footing")
"""Families of generated cages that ``formwork`` suits: the others are cast in the ground, or in stages."""


def check_suitable(environment: str, variants: Iterable[str]) -> None:
    """Raise ``InputError`` that lists the variants which cannot be built in an environment."""
    unsuitable = SURROUNDINGS[environment].unsuitable
    problems = [
        Problem(
            "conflict",
            repr(name),
            f"cannot be built in the environment {environment}",
            f"another variant, or an environment out of {', '.join(_environments_of(name))}",
        )
        for name in variants
        if name in unsuitable
    ]
    if problems:
        raise InputError.from_problems("appearance variants", problems)


def _environments_of(variant: str) -> list[str]:
    return [name for name, surroundings in SURROUNDINGS.items() if variant not in surroundings.unsuitable]
