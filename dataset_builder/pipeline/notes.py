"""Notes on scene files, printed to standard error."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from dataset_builder.scene.model import Note
from rebar_depth_bench.errors import printable

MAX_NOTES, _MAX_CHARACTERS = 20, 4000
"""Largest number of notes on scene files that are printed, and of characters of one."""


def print_notes(notes: Sequence[Note]) -> None:
    """Print notes on scene files to standard error, at most ``MAX_NOTES`` of them."""
    for note in notes[:MAX_NOTES]:
        print(printable(f"note: {note.source}: {note.text}", _MAX_CHARACTERS), file=sys.stderr)
    if len(notes) > MAX_NOTES:
        print(f"note: {len(notes) - MAX_NOTES} more notes are not shown", file=sys.stderr)
