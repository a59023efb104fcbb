"""Names in files: patterns of names and paths, and view ids.

A view id is ``<config>/<0000>``, or ``<config>/<split>-<scene>-<0000>`` in configs of several scenes.
"""

from __future__ import annotations

import re

NAME_PATTERN = "[A-Za-z0-9_][A-Za-z0-9_.-]{0,199}"
"""Regular expression of a name, which is one part of a path: it cannot be hidden, ``..`` or empty."""
NAME_LETTERS = 'letters, digits, "_", "." and "-", not starting with a dot'
"""Description of ``NAME_PATTERN`` for messages."""
PATH_PATTERN = f"({NAME_PATTERN}/){{0,9}}{NAME_PATTERN}"
"""Regular expression of up to ten names that are joined by ``/``."""
VIEW_ID_PATTERN = f"{NAME_PATTERN}/{NAME_PATTERN}"
"""Regular expression of a view id, ``<config>/<index>``."""

SPLITS = ("train", "validation", "test")
"""Splits that a config may have; a config of one scene has only the last."""
TEST_SPLIT = "test"
"""Split that is loaded, predicted and ranked by default."""
_SPLIT = re.compile(f"({'|'.join(SPLITS)})-.*-[0-9]{{4,}}")


def view_id(config: str, index: int, scene_prefix: str = "") -> str:
    """Return the id of a view from its index in the full trajectory.

    ``scene_prefix`` is ``<split>-<scene>-`` in configs of several scenes.
    """
    return f"{config}/{scene_prefix}{index:04d}"


def scene_prefix(split: str, scene: str) -> str:
    """Return the part of the view ids of a scene between config and index."""
    return f"{split}-{scene}-"


def config_of(view_id: str) -> str:
    """Return the config of a view: the part of ``view_id`` before the slash."""
    return view_id.partition("/")[0]


def split_of(view_id: str) -> str | None:
    """Return the split that a view id names; None if it names none."""
    match = _SPLIT.fullmatch(view_id.partition("/")[2])
    return match[1] if match else None


def scene_of(view_id: str) -> str:
    """Return what all view ids of a scene have in common: config, and split and scene if it has several."""
    return view_id.rstrip("0123456789")
