"""Progress callback type and a no-op callback."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, int, int], None]
"""Callback with the arguments: name of the task, number of steps done, total number of steps."""


def silent(task: str, done: int, total: int) -> None:
    """Ignore progress; the default callback."""
