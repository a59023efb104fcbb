"""Families of cages, by name: functions that draw a design with a random generator."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from dataset_builder.scene.cages.design import Design
from dataset_builder.scene.cages.families.beams import beam, joint
from dataset_builder.scene.cages.families.columns import column, pile_cage
from dataset_builder.scene.cages.families.surfaces import footing, slab, wall

FAMILIES: Mapping[str, Callable[[np.random.Generator], Design]] = {
    "column": column,
    "beam": beam,
    "wall": wall,
    "slab": slab,
    "footing": footing,
    "pile-cage": pile_cage,
    "joint": joint,
}
"""Functions that draw a design of each family; they raise ``InfeasibleError`` for parameters that do not fit."""
