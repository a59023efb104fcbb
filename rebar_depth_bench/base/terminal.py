"""Text on a terminal: characters that it can show, notices, and progress bars.

A terminal that is not UTF-8 (``LC_ALL=C``, code page 1252) lacks arrows and mathematical signs; no terminal shows
the undecodable bytes of a file name. They are printed as ``?`` in place of an error. Files are always UTF-8.
"""

from __future__ import annotations

import io
import os
import re
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import TextIO

from rich import progress
from rich.console import Console

from rebar_depth_bench.base.errors import printable

MAX_SILENCE_S = 600.0
"""Longest time between two lines of progress, if there is progress, seconds."""
_MAX_LINES = 100
_MAX_LINE_CHARACTERS = 2000


def prepare_terminal() -> None:
    """Let standard output and standard error print ``?`` for characters that their encoding lacks.

    Standard streams that are closed are opened on the null device: otherwise the next file would get their
    descriptor, and what libraries print would be written into it. A width of 0 counts as unset.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            stream = Path(os.devnull).open(mode)  # noqa: SIM115
            os.set_inheritable(stream.fileno(), True)
            setattr(sys, name, stream)
    if re.fullmatch("0+", os.environ.get("COLUMNS", "")):
        del os.environ["COLUMNS"]
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def terminal_text(message: str) -> str:
    """Return a message of several lines for a terminal: escape sequences are shown, long lines truncated.

    Messages quote files and servers, whose control characters could otherwise change what a terminal displays.
    """
    lines = message.split("\n")
    shown = []
    for line in lines[:_MAX_LINES]:
        escaped = "".join(char if char.isprintable() else ascii(char)[1:-1] for char in line)
        shown.append(escaped if len(escaped) <= _MAX_LINE_CHARACTERS else f"{escaped[:_MAX_LINE_CHARACTERS]}...")
    return "\n".join([*shown, *(["..."] if len(lines) > _MAX_LINES else [])])


def print_notice(text: str) -> None:
    """Print text to standard error; control characters of names in it are shown as escapes."""
    try:
        sys.stderr.write(f"{terminal_text(text)}\n")  # In one call, so that threads do not mix lines.
    except OSError:  # No note is worth a result.
        discard_stream(sys.stderr)


def discard_stream(stream: TextIO) -> None:
    """Discard text that cannot be written: the interpreter would try again, and complain, when it ends."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


@dataclass
class _Task:
    """Bar of a task, the steps done and the time when it was first shown, and the last line printed for it."""

    bar: progress.TaskID
    done: int
    seconds: float
    tenth: int = -1
    printed_s: float = 0.0


class ProgressBars:
    """Progress bars on standard error, one per task; plain lines if standard error is not a terminal.

    With ``pictures_per_step`` they show the rate of pictures and the remaining time, from the steps done since a
    task was first shown.
    """

    def __init__(self, pictures_per_step: int = 0) -> None:
        self._console = Console(stderr=True)
        self._pictures_per_step = pictures_per_step
        self._tasks: dict[str, _Task] = {}
        self._progress = progress.Progress(
            progress.TextColumn("{task.description}", markup=False),
            progress.BarColumn(),
            progress.MofNCompleteColumn(),
            progress.TimeElapsedColumn(),
            progress.TextColumn("{task.fields[rate]}") if pictures_per_step else progress.TimeRemainingColumn(),
            console=self._console,
            disable=not self._console.is_terminal,
        )

    def __enter__(self) -> ProgressBars:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def update(self, name: str, done: int, total: int) -> None:
        """Show that ``done`` of ``total`` steps of the task ``name`` are finished."""
        name = printable(name)
        now = time.monotonic()
        if name not in self._tasks:
            self._tasks[name] = _Task(self._progress.add_task(name, total=total, rate=""), done, now)
        task = self._tasks[name]
        steps, seconds, rate = done - task.done, now - task.seconds, ""
        if self._pictures_per_step and steps > 0 and seconds > 0:
            per_minute = 60 * steps * self._pictures_per_step / seconds
            left = timedelta(seconds=round((total - done) * seconds / steps))
            rate = f"{per_minute:.3g} pictures/min, {left} left"
        self._progress.update(task.bar, completed=done, total=total, rate=rate)
        tenth = done * 10 // max(total, 1)
        # A line for each tenth of the task, and at least one every ten minutes, keeps log files short.
        if not self._console.is_terminal and (tenth != task.tenth or now - task.printed_s >= MAX_SILENCE_S):
            task.tenth, task.printed_s = tenth, now
            print_notice(f"{name}: {done} of {total}{rate and f', {rate}'}")
