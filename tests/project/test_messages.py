"""The messages about rejected inputs equal the reviewed ones."""

from __future__ import annotations

from pathlib import Path

from tests.data.messages import messages

REVIEWED = Path(__file__).parents[1] / "data" / "messages.txt"


def test_messages_equal_reviewed_ones() -> None:
    assert "\n".join(messages()) == REVIEWED.read_text(), "python -m tests.data.messages > tests/data/messages.txt"
