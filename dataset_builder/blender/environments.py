"""What a scene stands in: the surfaces round the steel, and the light on them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from dataset_builder.blender.laboratory import BENCH_TOP_M, laboratory
from dataset_builder.blender.light_rigs import LABORATORY_LIGHT, OUTDOOR_LIGHT
from dataset_builder.blender.lighting import LightRig
from dataset_builder.blender.outdoors import outdoors
from dataset_builder.model import Part


@dataclass(frozen=True)
class Environment:
    """A place: its surfaces (world frame, none of them steel), and its light by light variant (None: as it is)."""

    parts: Callable[[], tuple[Part, ...]]
    light: Mapping[str | None, LightRig]
    floor_m: float
    """Height of the surface that a board lies on."""


ENVIRONMENTS: Mapping[str, Environment] = {
    "laboratory": Environment(laboratory, LABORATORY_LIGHT, BENCH_TOP_M),
    "outdoors": Environment(outdoors, OUTDOOR_LIGHT, 0.0),
}
