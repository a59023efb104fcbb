"""Families of cages by name: the shapes of each, and the function that draws a design of a shape."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from dataset_builder.scene.cages.design import Design
from dataset_builder.scene.cages.families.beams import beam
from dataset_builder.scene.cages.families.columns import column, pile_cage
from dataset_builder.scene.cages.families.footings import footing
from dataset_builder.scene.cages.families.joints import joint
from dataset_builder.scene.cages.families.slabs import slab
from dataset_builder.scene.cages.families.walls import wall


@dataclass(frozen=True)
class Family:
    """Family of cages: a function that draws a design of a shape, and the shapes.

    ``draw`` raises ``InfeasibleError`` for drawn parameters that do not fit.
    """

    draw: Callable[[np.random.Generator, str], Design]
    shapes: tuple[str, ...]


FAMILIES: Mapping[str, Family] = {
    "column": Family(column, ("square", "rectangular", "round-ties", "spiral")),
    "beam": Family(beam, ("straight", "hooked")),
    "wall": Family(wall, ("plain", "laps", "u-bars")),
    "slab": Family(slab, ("two-mats",)),
    "footing": Family(footing, ("bobs", "full-height")),
    "pile-cage": Family(pile_cage, ("spiral", "rings")),
    "joint": Family(joint, ("corner", "passing")),
}
