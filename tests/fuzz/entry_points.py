"""Registry of the entry points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from tests.fuzz.capture_entries import CAPTURE_ENTRIES
from tests.fuzz.dataset_entries import DATASET_ENTRIES
from tests.fuzz.entry_point import EntryPoint
from tests.fuzz.model_entries import MODEL_ENTRIES
from tests.fuzz.scene_entries import SCENE_ENTRIES

ENTRY_POINTS: Mapping[str, EntryPoint] = {
    entry.name: entry for entry in (*DATASET_ENTRIES, *SCENE_ENTRIES, *CAPTURE_ENTRIES, *MODEL_ENTRIES)
}
"""Entry points by name."""


def number_of_cases(total: int, entries: Sequence[str]) -> dict[str, int]:
    """Return how many of ``total`` cases each of the named entry points gets by its share, at least one."""
    shares = sum(ENTRY_POINTS[name].share for name in entries)
    return {name: max(1, round(total * ENTRY_POINTS[name].share / shares)) for name in entries}
