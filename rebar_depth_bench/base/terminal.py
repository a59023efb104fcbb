"""Text on a terminal: characters that it can show, notices, and progress bars.

A terminal that is not UTF-8 (``LC_ALL=C``, code page 1252) lacks arrows and mathematical signs; no terminal shows
the undecodable bytes of a file name. Such characters are replaced in place of an error. Files are always UTF-8.
"""

from __future__ import annotations

import codecs
import io
import os
import re
import sys
import time
import unicodedata
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.progress import TimeRemainingColumn as Remaining

from rebar_depth_bench.base.errors import printable

_REPLACEMENTS = str.maketrans(
    {
        "↓": "v",
        "↑": "^",
        "→": ">",
        "−": "-",
        "–": "-",
        "—": "-",
        "×": "x",
        "±": "+-",
        "†": "+",
        "‡": "#",
        "§": "$",
        "δ": "d",
        "µ": "u",
        "μ": "u",
        "°": " deg",
        "∞": "inf",
        "…": "...",
        "≤": "<=",
        "≥": ">=",
        "\N{REPLACEMENT CHARACTER}": "?",
    }
)
"""Replacements by character; those of headings and marks have one character, so that columns stay aligned."""


def prepare_terminal() -> None:
    """Let standard output and standard error replace characters that their encoding lacks.

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
            stream.reconfigure(errors=_HANDLER)


def plain_characters(text: str) -> str:
    """Return text in ASCII: known signs by name or look, letters without their accents, ``?`` for all others."""
    decomposed = unicodedata.normalize("NFKD", text.translate(_REPLACEMENTS))
    kept = (character for character in decomposed if not unicodedata.combining(character))
    return "".join(character if character.isascii() else "?" for character in kept)


def _replace_unencodable(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return plain_characters(error.object[error.start : error.end]), error.end


_HANDLER = "rebar-plain"
codecs.register_error(_HANDLER, _replace_unencodable)

_MAX_LINES = 100
_MAX_LINE_CHARACTERS = 2000


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


MAX_SILENCE_S = 600.0
"""Longest time between two lines of progress, if there is progress, seconds."""


@dataclass(frozen=True)
class Rate:
    """Rate of a task for the display: the name of what is counted, and how many of them are one step."""

    unit: str
    per_step: int

    def text(self, steps: int, remaining: int, seconds: float) -> str:
        """Return the rate of ``steps`` done in ``seconds``, and the time for the remaining ones."""
        if steps < 1 or seconds <= 0:
            return ""
        per_minute = 60 * steps * self.per_step / seconds
        return f"{per_minute:.3g} {self.unit}/min, {duration_text(remaining * seconds / steps)} left"


def duration_text(seconds: float) -> str:
    """Return a duration in its two largest units of hours, minutes and seconds."""
    hours, minutes = divmod(round(seconds / 60), 60)
    if seconds < 59.5:
        return f"{seconds:.0f} s"
    if seconds < 600:
        return f"{round(seconds) // 60} min {round(seconds) % 60} s"
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"


@dataclass
class _Started:
    """State of a task when it was first shown, and the last line printed for it."""

    done: int
    seconds: float
    tenth: int = -1
    printed_s: float = 0.0


class ProgressBars:
    """Progress bars on standard error, one per task; plain lines if standard error is not a terminal.

    With a ``rate`` they show it and the remaining time, from the steps done since a task was first shown.
    """

    def __init__(self, rate: Rate | None = None) -> None:
        self._console = Console(stderr=True)
        self._bars: dict[str, TaskID] = {}
        self._started: dict[str, _Started] = {}
        self._rate = rate
        self._progress = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[rate]}") if rate else Remaining(),
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
        started = self._started.setdefault(name, _Started(done, now))
        rate = self._rate.text(done - started.done, total - done, now - started.seconds) if self._rate else ""
        if not self._console.is_terminal:
            _print_line(
                started, now, f"{name}: {done} of {total}{rate and f', {rate}'}", done * 10 // max(total, 1)
            )
            return
        if name not in self._bars:
            self._bars[name] = self._progress.add_task(name, total=total, rate=rate)
        self._progress.update(self._bars[name], completed=done, total=total, rate=rate)


def _print_line(started: _Started, now: float, line: str, tenth: int) -> None:
    """Print a line at each tenth of the task, and at least every ten minutes, which keeps log files short."""
    if tenth != started.tenth or now - started.printed_s >= MAX_SILENCE_S:
        started.tenth, started.printed_s = tenth, now
        print_notice(line)
