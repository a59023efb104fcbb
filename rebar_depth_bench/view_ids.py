"""View ids: ``<config>/<0000>``, or ``<config>/<split>-<scene>-<0000>`` in configs of several scenes."""

from __future__ import annotations

import re

SPLITS = ("train", "validation", "test")
"""Splits that a config may have; a config of one scene has only the last."""
TEST_SPLIT = "test"
"""Split that is loaded, predicted and ranked by default."""
_SPLIT = re.compile(f"({'|'.join(SPLITS)})-.*-[0-9]{{4,}}")


def config_of(view_id: str) -> str:
    """Return the config of a view: the part of ``view_id`` before the slash."""
    return view_id.partition("/")[0]


def split_of(view_id: str) -> str | None:
    """Return the split that a view id names; None if it names none."""
    match = _SPLIT.fullmatch(view_id.partition("/")[2])
    return match[1] if match else None
