"""Command-line basics of all programs: progress, exit codes, and shared options."""

from __future__ import annotations

import argparse
import os
import sys
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from importlib.util import find_spec

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.progress import TimeRemainingColumn as Remaining

from rebar_depth_bench.atomic_io import WRITE_ERRORS
from rebar_depth_bench.errors import InputError, RebarDepthError, printable, terminal_text
from rebar_depth_bench.reading import parse_number

EXIT_DONE, EXIT_OTHER, EXIT_INPUT = 0, 1, 2
"""Exit codes: success, any other error, invalid input."""


MAX_SILENCE_S = 600.0
"""Longest time between two lines of progress, if there is progress, seconds."""

MAX_SECONDS = 1e6
"""Longest duration that an option accepts, seconds; Python cannot wait for more than some 1e10."""


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
        sys.stderr.write(line + "\n")  # In one call: several threads may write lines.
        sys.stderr.flush()


def require_extra(extra: str, modules: Sequence[str]) -> None:
    """Raise ``InputError`` if a module of an extra of this distribution is not installed.

    Modules that need the extra are imported only after this check.
    """
    missing = [name for name in modules if find_spec(name) is None]
    if missing:
        raise InputError(
            f"not installed: {', '.join(missing)}; expected the {extra} extra: "
            f"pip install 'rebar-depth-bench[{extra}]'"
        )


@dataclass(frozen=True)
class Command:
    """Command of a program: its module, with ``add_arguments(parser)`` and ``run(options)``, and its summary.

    ``run`` prints results to standard output and progress to standard error, and raises ``RebarDepthError``.
    """

    module: str
    summary: str


def add_commands(
    subparsers: argparse._SubParsersAction[argparse.ArgumentParser],
    commands: Mapping[str, Command],
    words: Sequence[str] | None,
) -> None:
    """Add a parser for each command by name, with the arguments of those that ``words`` contains.

    Only the modules of these are imported, since an import may take seconds. ``words`` are those of a command
    line; if they are None, all commands have their arguments.
    """
    for name, command in commands.items():
        parser = subparsers.add_parser(name, help=command.summary, description=command.summary)
        if words is None or name in words:
            module = import_module(command.module)
            module.add_arguments(parser)
            parser.set_defaults(run=module.run)


def run_command(command: Callable[[], None], interrupted: str = "interrupted") -> int:
    """Run a command and return its exit code.

    A ``RebarDepthError``, and an error of a machine that cannot write, is printed to standard error without a
    traceback. If nobody reads standard output any more, the command ends without a message. ``interrupted`` is the
    message printed on Ctrl-C.
    """
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module=r"PIL\.")  # Errors name the image and its file.
            command()
        sys.stdout.flush()
    except RebarDepthError as error:
        print_notice(f"error: {error}")
        return EXIT_INPUT if isinstance(error, InputError) else EXIT_OTHER
    except BrokenPipeError:
        _discard_standard_output()
        return EXIT_OTHER
    except OSError as error:
        if error.errno not in WRITE_ERRORS:
            raise
        print_notice(f"error: {error.filename or 'standard output'}: {os.strerror(error.errno)}")
        _discard_standard_output()
        return EXIT_OTHER
    except KeyboardInterrupt:
        print(interrupted, file=sys.stderr)
        return EXIT_OTHER
    return EXIT_DONE


def _discard_standard_output() -> None:
    """Discard text that cannot be written: the interpreter would try again, and complain, when it ends."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def add_archive(parser: argparse.ArgumentParser) -> None:
    """Add the positional argument ``archive``."""
    parser.add_argument("archive", metavar="ARCHIVE", help="submission archive (zip)")


def add_data(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--data``."""
    parser.add_argument("--data", required=True, metavar="ROOT", help="dataset folder or Hub repository id")


def add_workers(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--workers``."""
    parser.add_argument("--workers", type=int, metavar="N", help="number of threads (default: one per core)")


def add_seconds(container: argparse._ActionsContainer, option: str, default: float, summary: str) -> None:
    """Add ``option``, a duration in seconds, to a parser or a group of options."""
    container.add_argument(
        option,
        type=partial(positive_number, expected=f"a number above 0, up to {MAX_SECONDS:g}", high=MAX_SECONDS),
        default=default,
        metavar="SECONDS",
        help=f"{summary} (default: {default:g})",
    )


def positive_number(text: str, expected: str, high: float = sys.float_info.max) -> float:
    """Return the number of an option, above 0 and up to ``high``; raise the error that names what is expected."""
    value = parse_number(text)
    if not 0 < value <= high:
        raise argparse.ArgumentTypeError(f"{text!r} is not {expected}")
    return value


def print_notice(text: str) -> None:
    """Print text to standard error; control characters of names in it are shown as escapes."""
    print(terminal_text(text), file=sys.stderr)
