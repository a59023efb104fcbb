"""What a scene stands in: the surfaces round the steel, and the light on them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from dataset_builder.blender.laboratory import laboratory
from dataset_builder.blender.lighting import add_laboratory_lights
from dataset_builder.model import Part


@dataclass(frozen=True)
class Environment:
    """A place: its surfaces (world frame, none of them steel) and a function that lights the open scene."""

    parts: Callable[[], tuple[Part, ...]]
    add_lights: Callable[[], None]


ENVIRONMENTS: Mapping[str, Environment] = {
    "laboratory": Environment(laboratory, add_laboratory_lights),
}
