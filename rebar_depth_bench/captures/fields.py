"""Keys and lens models of the files of other programs.

A reader names every key that it does not know. Lens models beyond k1 k2 p1 p2 k3, stated by name or by the number
of terms, are refused in one way in all formats.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from rebar_depth_bench.base.errors import Problem, escape_text
from rebar_depth_bench.base.validation import short_repr

READABLE = """\
Stereolabs' *.conf, OpenCV's FileStorage or ROS camera_info (*.yml, *.yaml, *.xml, *.json), or calibration.toml:
    width = 1280
    height = 720
    [left]
    fx = 701.88  # pixels
    fy = 701.7
    cx = 641.285  # pixel centres at integers
    cy = 344.1835
    distortion = [-0.175, 0.0283, 0.0001, -0.0002, 0.0]  # k1 k2 p1 p2 k3
    [right]  # of a pair, also [stereo]
    K = [[701, 0, 633.5], [0, 701, 359.3], [0, 0, 1]]
    distortion = [0, 0, 0, 0]
    [stereo]  # x_right = R x_left + T
    rotation = [0.001, 0.006, 0]  # Rodrigues vector, radians
    translation_m = [-0.12, 0, 0]"""
"""Calibrations that are read, for the message that refuses others."""
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


def unknown_keys_notes(source: str, keys: Iterable[Any], known: Collection[str]) -> list[str]:
    """Return a note that names the ``keys`` of the file ``source`` that are not ``known``; none if all are."""
    unknown = [escape_text(str(key)) for key in keys if key not in known]
    if not unknown:
        return []
    more = f" and {len(unknown) - _MAX_NAMED} more" if len(unknown) > _MAX_NAMED else ""
    return [f"{source}: fields without a known meaning are left out: {', '.join(unknown[:_MAX_NAMED])}{more}"]


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
