"""Fields of the files of other programs: those that a reader uses or checks, and those that change no number.

A reader looks up its values in the table of its format and names every field that the table does not list.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from rebar_depth_bench.base.errors import escape_text

_MAX_NAMED = 10


@dataclass(frozen=True)
class Field:
    """Field of a format: its keys in files, of which the first one present counts, and what a reader does with it.

    ``use`` is "used" if the value becomes part of the result, "checked" if a file is refused unless the value is
    as ``meaning`` says, and "harmless" if it changes no number.
    """

    name: str
    keys: tuple[str, ...]
    use: Literal["used", "checked", "harmless"]
    meaning: str


@dataclass(frozen=True)
class FileFormat:
    """Format of a file of another program. Keys are compared without case and punctuation."""

    title: str
    fields: tuple[Field, ...]

    def keys(self, name: str) -> tuple[str, ...]:
        """Return the keys of a field."""
        return next(field.keys for field in self.fields if field.name == name)

    def notes(self, source: str, keys: Iterable[str]) -> list[str]:
        """Return a note that names the ``keys`` of the file ``source`` that are not listed; none if all are."""
        listed = {plain_key(key) for field in self.fields for key in field.keys}
        unlisted = [escape_text(key) for key in keys if plain_key(key) not in listed]
        if not unlisted:
            return []
        more = f" and {len(unlisted) - _MAX_NAMED} more" if len(unlisted) > _MAX_NAMED else ""
        return [f"{source}: fields without a known meaning are left out: {', '.join(unlisted[:_MAX_NAMED])}{more}"]


def plain_key(key: str) -> str:
    """Return a key without case and punctuation."""
    return re.sub("[^a-z0-9]", "", key.lower())
