"""Selection of the objects of a user's file by patterns of their names and by a box."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from pydantic import TypeAdapter

CLASS = "class"
KEYS = (CLASS, "global_id", "name", "host", "storey", "layer")
"""Names of an object that a pattern can be for; a part of a mesh file has a ``name`` only."""

Corner = tuple[float, float, float]


@dataclass(frozen=True)
class Selection:
    """Table ``[[select]]``: glob patterns by key, and a box (lower and upper corner, the file's frame and unit).

    In a pattern, ``*`` stands for any text, ``?`` for one character and ``[ab]`` for one of several. Classes are
    compared without regard to case.
    """

    patterns: tuple[tuple[str, str], ...] = ()
    box: tuple[Corner, Corner] | None = None

    @property
    def has_class(self) -> bool:
        """Whether the table names a class."""
        return any(key == CLASS for key, _ in self.patterns)

    def matches(self, names: Mapping[str, Collection[str]]) -> bool:
        """Return whether each pattern matches one of an object's names under its key, whatever the box."""
        return all(
            any(_matches(key, name, pattern) for name in names.get(key, ())) for key, pattern in self.patterns
        )

    def contains(self, points: Float64[ndarray, "n 3"]) -> bool:
        """Return whether all points (the file's frame and unit) are in the box; True without a box."""
        if self.box is None:
            return True
        lower, upper = np.array(self.box)
        return bool(((lower <= points) & (points <= upper)).all())


def _matches(key: str, name: str, pattern: str) -> bool:
    if key == CLASS:
        name, pattern = name.casefold(), pattern.casefold()
    return fnmatchcase(name, pattern)


TABLES: TypeAdapter[tuple[Selection, ...]] = TypeAdapter(tuple[Selection, ...])
"""Converter of tables to and from JSON."""
