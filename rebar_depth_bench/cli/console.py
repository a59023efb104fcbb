"""What the commands share: progress on standard error, and errors as words with an exit status."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.progress import TimeRemainingColumn as Remaining

from rebar_depth_bench.errors import InputError, RebarDepthError

EXIT_DONE, EXIT_OTHER, EXIT_INPUT = 0, 1, 2


class ProgressBars:
    """One bar per piece of long work, on standard error; a line now and then where that is no terminal."""

    def __init__(self) -> None:
        self._console = Console(stderr=True)
        self._bars: dict[str, TaskID] = {}
        self._lines: dict[str, int] = {}
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            Remaining(),
            console=self._console,
            disable=not self._console.is_terminal,
        )

    def __enter__(self) -> ProgressBars:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def update(self, name: str, done: int, total: int) -> None:
        """Show that ``done`` of ``total`` steps of ``name`` are finished."""
        if not self._console.is_terminal:
            self._print_line(name, done, total)
            return
        if name not in self._bars:
            self._bars[name] = self._progress.add_task(name, total=total)
        self._progress.update(self._bars[name], completed=done, total=total)

    def _print_line(self, name: str, done: int, total: int) -> None:
        """Print at every tenth of the work, so that a log stays short."""
        tenth = done * 10 // max(total, 1)
        if self._lines.get(name) != tenth:
            self._lines[name] = tenth
            print(f"{name}: {done} of {total}", file=sys.stderr, flush=True)


def run_command(command: Callable[[], None], interrupted: str = "interrupted") -> int:
    """Run a command and return the contract's exit status; our errors become words on standard error."""
    try:
        command()
    except RebarDepthError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_INPUT if isinstance(error, InputError) else EXIT_OTHER
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_OTHER
    except KeyboardInterrupt:
        print(interrupted, file=sys.stderr)
        return EXIT_OTHER
    return EXIT_DONE
