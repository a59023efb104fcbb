"""Specs of assemblies that are read from a user's file: content, placement and selected objects.

Like all specs, they are written to the manifest: field names and defaults are part of the dataset format.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from fnmatch import fnmatchcase
from typing import Literal

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from pydantic import TypeAdapter

from rebar_depth_bench.base.errors import escape_text

Up = Literal["z", "y"]
Origin = Literal["centre", "keep"]
Trust = Literal["declared", "geometry"]
"""What to believe if the diameters of a bar are far apart: "declared" refuses it, "geometry" only notes it."""


@dataclass(frozen=True)
class PlacementSpec:
    """Placement of a file's bars in the world, in the order of the fields (``user_files.cage_placement``).

    ``up`` is the file's vertical axis. With the ``origin`` "centre" the steel is centred above the world's origin
    and set on the ground, with "keep" the file's origin is the world's. The steel is then turned about the z axis
    by ``rotate_deg`` and moved by ``translate_m``.
    """

    up: Up = "z"
    origin: Origin = "keep"
    rotate_deg: float = 0.0
    translate_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


CLASS = "class"
KEYS = (CLASS, "global_id", "name", "host", "storey", "layer")
"""Names of an object that a pattern can be for; a part of a mesh file has a ``name`` only."""

_MAX_NAME, _MAX_COMPARED, _MAX_NEAREST = 60, 10_000, 3
"""Limits of the names in a message about a selection: their characters, how many are compared, and listed."""

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


def nearest_names(select: Iterable[Selection], known: Mapping[str, Collection[str]]) -> str:
    """Return words for a message: the names nearest to patterns that match no ``known`` name of their keys.

    The words are empty if each pattern matches a name. At most ``_MAX_NEAREST`` patterns are named, and the first
    ``_MAX_COMPARED`` names of a key are compared, without regard to case.
    """
    words: list[str] = []
    for key, pattern in dict.fromkeys(pair for table in select for pair in table.patterns):
        names = known.get(key, ())
        if names and not any(_matches(key, name, pattern) for name in names) and len(words) < _MAX_NEAREST:
            by_plain = {name[:_MAX_NAME].casefold(): name for name in sorted(names)[:_MAX_COMPARED]}
            near = get_close_matches(pattern[:_MAX_NAME].casefold(), by_plain, n=_MAX_NEAREST, cutoff=0.3)
            shown = [escape_text(by_plain[name][:_MAX_NAME]) for name in near or list(by_plain)[:_MAX_NEAREST]]
            words.append(f"; nearest to {key} {escape_text(pattern[:_MAX_NAME])}: {', '.join(shown)}")
    return "".join(words)


TABLES: TypeAdapter[tuple[Selection, ...]] = TypeAdapter(tuple[Selection, ...])
"""Converter of tables to and from JSON."""


@dataclass(frozen=True)
class PinnedFile:
    """User's file with the digest of the content that it had when it was chosen."""

    path: str
    sha256: str


@dataclass(frozen=True)
class CageFileSpec(PinnedFile):
    """Assembly read bar by bar from a TOML or IFC file.

    ``select`` are the tables of which one must match an object; without any, all reinforcement of the file is
    taken. ``trust`` decides about declared diameters. Both are for IFC files only.
    """

    placement: PlacementSpec = PlacementSpec()
    select: tuple[Selection, ...] = ()
    trust: Trust = "declared"
    kind: str = "cage-file"


@dataclass(frozen=True)
class MeshFileSpec(PinnedFile):
    """Assembly read from a mesh file; ``unit_m`` is one file unit in metres, ``select`` chooses its parts."""

    unit_m: float
    placement: PlacementSpec = PlacementSpec()
    select: tuple[Selection, ...] = ()
    kind: str = "mesh-file"
