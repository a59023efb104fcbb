"""What the commands share: progress on standard error, and errors as words with an exit status."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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


@contextmanager
def exiting_in_words() -> Iterator[None]:
    """Turn this project's errors into one message on standard error and the contract's exit status."""
    try:
        yield
    except InputError as error:
        _complain(error, EXIT_INPUT)
    except RebarDepthError as error:
        _complain(error, EXIT_OTHER)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(EXIT_OTHER) from None
    except KeyboardInterrupt:
        print("interrupted; run the same command again to go on", file=sys.stderr)
        raise SystemExit(EXIT_OTHER) from None


def run_command(command: Callable[[], None]) -> int:
    """Run a command under ``exiting_in_words`` and return its exit status."""
    with exiting_in_words():
        command()
    return EXIT_DONE


def _complain(error: RebarDepthError, status: int) -> None:
    print(f"error: {error}", file=sys.stderr)
    raise SystemExit(status) from None
