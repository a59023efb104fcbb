"""Fields of the files of other programs: those that a reader uses or checks, and those that change no number.

A reader looks up its values in the table of its format and names every field that the table does not list. Lens
models beyond k1 k2 p1 p2 k3, stated by name or by the number of terms, are refused in one way in all formats.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from rebar_depth_bench.base.errors import Problem, escape_text
from rebar_depth_bench.base.validation import short_repr

_MAX_NAMED = 10
LENS_TERMS = ("k1", "k2", "p1", "p2", "k3")
"""Distortion terms that are used, in OpenCV's order."""
DISTORTION_TERMS = len(LENS_TERMS)
_RADIAL = (
    *("plumbbob", "radtan", "radialtangential", "brown", "brownconrady", "opencv", "rationalpolynomial"),
    *("0", "false"),
)
"""Lens models, or answers to whether it is a fisheye lens, whose first terms are k1 k2 p1 p2 k3; as plain keys."""
RECTIFY_PAGE = 'see "Rectify images first" in docs/captures.md'
_KNOWN_LENS = (
    f"{' '.join(LENS_TERMS)} (plumb_bob, radtan); rectify the images first with the camera's own software or "
    f"OpenCV, {RECTIFY_PAGE}, and give their new K with zero distortion"
)
"""Lens model that is read, and the remedy for others."""
OTHER_LENS = re.compile(
    r"fish|omnidir|\bomni\b|equidist|kannala|rational|thin.?prism|unified|double.?sphere", re.I
)
"""Part of the name of another lens model, by which a text with an unknown key is refused."""
_UNDISTORTED = ("none", "")
_PINHOLE = ("pinhole", "perspective")
"""Names of a projection without a statement about the distortion."""


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
        """Return the keys of a field; none if the format does not have it."""
        return next((field.keys for field in self.fields if field.name == name), ())

    def notes(self, source: str, keys: Iterable[Any]) -> list[str]:
        """Return a note that names the ``keys`` of the file ``source`` that are not listed; none if all are."""
        listed = {plain_key(key) for field in self.fields for key in field.keys}
        unlisted = [escape_text(str(key)) for key in keys if plain_key(str(key)) not in listed]
        if not unlisted:
            return []
        more = f" and {len(unlisted) - _MAX_NAMED} more" if len(unlisted) > _MAX_NAMED else ""
        return [f"{source}: fields without a known meaning are left out: {', '.join(unlisted[:_MAX_NAMED])}{more}"]


def plain_key(key: str) -> str:
    """Return a key without case and punctuation."""
    return re.sub("[^a-z0-9]", "", key.lower())


def lens_problem(where: str, models: Mapping[str, Any], terms: Sequence[float] = ()) -> Problem | None:
    """Return the problem of a lens that k1 k2 p1 p2 k3 do not describe, or None.

    ``models`` are the stated models, such as ``{"distortion_model": "equidistant"}``, and ``terms`` the distortion
    in OpenCV's order. Further terms may be 0. Four terms may be those of a fisheye lens and need a stated model.
    """
    texts = {key: "" if model is None else str(model) for key, model in models.items()}
    plain = {key: plain_key(text) or text.strip() for key, text in texts.items()}
    stated_radial = any(model in _RADIAL for model in plain.values())
    others = [key for key, model in plain.items() if model not in (*_RADIAL, *_PINHOLE, *_UNDISTORTED)]
    expected = _KNOWN_LENS
    if others:
        found = f"{escape_text(others[0])} is {short_repr(models[others[0]])}"
    elif any(terms[DISTORTION_TERMS:]):
        kind = "tilted" if any(terms[12:]) else "thin prism" if any(terms[8:]) else "fisheye or rational"
        found = f"the distortion has {len(terms)} terms: {kind} distortion"
    elif any(terms) and "none" in plain.values():
        found, expected = "distortion terms beside a model of none", "zeros, or the model of the terms"
    elif any(terms) and len(terms) == 4 and not stated_radial:
        found = "four distortion terms without a stated model may be those of a fisheye lens"
        remedy = "add distortion_model: plumb_bob, or a fifth term k3 = 0, if they are k1 k2 p1 p2"
        expected = f"{remedy}; otherwise {_KNOWN_LENS}"
    elif any(terms) and len(terms) < 4:
        found = f"the distortion has {len(terms)} terms"
    else:
        return None
    return Problem("invalid", where, found, expected)
