"""Command lines of all programs: commands, exit codes, shared options, and the check of output files."""

from __future__ import annotations

import argparse
import errno
import os
import re
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path, PosixPath
from typing import TYPE_CHECKING

from rebar_depth_bench import software_version
from rebar_depth_bench.base.errors import InputError, OutputError, RebarDepthError
from rebar_depth_bench.base.reading import parse_number
from rebar_depth_bench.base.terminal import ProgressBars, discard_stream, prepare_terminal, print_notice
from rebar_depth_bench.base.writing import STANDARD_OUTPUT, WRITE_ERRORS, is_stream, link_target

if TYPE_CHECKING:
    from rebar_depth_bench.data.manifest import DatasetFolder
    from rebar_depth_bench.scoring.result import Result

EXIT_DONE, EXIT_OTHER, EXIT_INPUT = 0, 1, 2
"""Exit codes: success, any other error, invalid input."""

STANDARD_OUTPUT_OPTIONS = ("--json", "--csv")
"""Options whose file may be ``-``, standard output."""

MAX_SECONDS = 1e6
"""Longest duration that an option accepts, seconds; Python cannot wait for more than some 1e10."""


@dataclass(frozen=True)
class Command:
    """Command of a program: its summary, what adds its arguments to a parser, and what runs it with the options.

    ``run`` prints results to standard output and progress to standard error, and raises ``RebarDepthError``.
    """

    summary: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], None]


def module_command(module: str, summary: str, add: str = "add_arguments", run: str = "run") -> Command:
    """Return the command of the functions ``add`` and ``run`` of a module, imported when they are called."""
    return Command(
        summary,
        lambda parser: getattr(import_module(module), add)(parser),
        lambda options: getattr(import_module(module), run)(options),
    )


def program_parser(
    program: str,
    description: str,
    commands: Mapping[str, Command],
    words: Sequence[str] | None = None,
    epilog: str | None = None,
) -> argparse.ArgumentParser:
    """Return the argument parser of a program with several commands.

    Commands have their arguments if the words of a command line contain their name, or all if ``words`` is None:
    the modules of a command may take seconds to import.
    """
    parser = argparse.ArgumentParser(prog=program, description=description, epilog=epilog)
    parser.add_argument("--version", action="version", version=software_version())
    subparsers = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, command in commands.items():
        subparser = subparsers.add_parser(name, help=command.summary, description=command.summary)
        if words is None or name in words:
            command.add_arguments(subparser)
            subparser.set_defaults(run=command.run)
    return parser


def run_program(parser: argparse.ArgumentParser, words: Sequence[str] | None = None) -> int:
    """Parse the words of a command line, check the outputs, call ``run(options)`` and return the exit code.

    ``run`` is a default of the parser or of a command, as is ``interrupted``, the message printed on Ctrl-C, if it
    has one.
    """

    def run() -> None:
        options = parser.parse_args(words)
        try:
            Path.cwd()
        except FileNotFoundError:
            raise InputError("the current folder was removed: change to one that exists") from None
        check_outputs(vars(options))
        try:
            options.run(options)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(getattr(options, "interrupted", "interrupted")) from None

    return run_command(run)


def run_command(command: Callable[[], None], interrupted: str = "interrupted") -> int:
    """Run a command and return its exit code.

    A ``RebarDepthError``, and an error of a machine that cannot write, is printed to standard error without a
    traceback. If nobody reads standard output any more, the command ends without a message. On Ctrl-C, the text of
    the ``KeyboardInterrupt`` is printed, or ``interrupted`` if it has none.
    """
    prepare_terminal()
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module=r"PIL\.")  # Errors name the image and its file.
            command()
        sys.stdout.flush()
    except RebarDepthError as error:
        print_notice(f"error: {error}")
        return EXIT_INPUT if isinstance(error, InputError) else EXIT_OTHER
    except BrokenPipeError:
        discard_stream(sys.stdout)
        return EXIT_OTHER
    except OSError as error:
        if error.errno not in (*WRITE_ERRORS, errno.EBADF):  # Standard output may be open for reading only.
            raise
        print_notice(f"error: {error.filename or 'standard output'}: {os.strerror(error.errno)}")
        discard_stream(sys.stdout)
        return EXIT_OTHER
    except KeyboardInterrupt as error:
        print_notice(str(error) or interrupted)
        return EXIT_OTHER
    return EXIT_DONE


class InputFile(str):
    """Argument that names a file to read; a method may be ``FILE.py:NAME``, ``FILE.toml`` or no file."""


class InputFolder(str):
    """Argument that names a folder to read, or a file or Hub repository in its place."""


class OutputFile(PosixPath):
    """Argument that names a file to write."""


class OutputArchive(OutputFile):
    """Argument that names a submission archive to write, which may be inside an input folder."""


class OutputFolder(OutputFile):
    """Argument that names a folder to write files to, new or existing; several may be the same."""


def add_archive(parser: argparse.ArgumentParser) -> None:
    """Add the positional argument ``archive``."""
    parser.add_argument("archive", type=InputFile, metavar="ARCHIVE", help="submission archive (zip)")


def add_data(parser: argparse.ArgumentParser, summary: str = "dataset folder or Hub repository id") -> None:
    """Add the option ``--data``."""
    parser.add_argument("--data", type=InputFolder, required=True, metavar="ROOT", help=summary)


def add_names(parser: argparse.ArgumentParser, option: str, help_text: str, metavar: str = "NAME") -> None:
    """Add ``option``, which takes one name or more and may be repeated."""
    parser.add_argument(option, nargs="+", action="extend", metavar=metavar, help=help_text)


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


def add_scored_data(parser: argparse.ArgumentParser) -> None:
    """Add the options of the dataset, and the one that scores metric archives as those of another kind."""
    from rebar_depth_bench.submission.declaration import METRIC, PREDICTION_KINDS  # Most commands do not need it.

    add_data(parser)
    add_expect_digest(parser)
    parser.add_argument(
        "--align",
        choices=[kind for kind in PREDICTION_KINDS if kind != METRIC],
        help="score metric predictions as this kind, aligned with the truth of each view; never ranked",
    )


def add_expect_digest(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--expect-digest``."""
    parser.add_argument(
        "--expect-digest",
        metavar="DIGEST",
        help="refuse any other dataset than that with this ground-truth digest (sha256:...)",
    )


def score_archives(
    archives: Sequence[str],
    options: argparse.Namespace,
    check_kinds: Callable[[Sequence[tuple[str, str]]], None] | None = None,
    *,
    extended: bool = False,
) -> list[Result]:
    """Score archives with a command's options; before any, call ``check_kinds`` with method and kind of each.

    With ``extended``, all must be metric and of a config with bar ids.
    """
    from rebar_depth_bench.data.manifest import open_folder  # Most commands do not score.
    from rebar_depth_bench.scorer import score
    from rebar_depth_bench.scoring.evaluation import open_evaluation

    folder = open_folder(options.data, expect_digest=options.expect_digest)
    align = None if extended else options.align
    kinds = []
    for archive in archives:  # Opened twice: kinds that do not fit are refused before the first is scored.
        with open_evaluation(archive, folder) as evaluation:
            kinds.append((evaluation.meta.method, evaluation.scored_kind(align)))
            if extended:
                # A third of the package, which other commands do not need.
                from rebar_depth_bench.extended.ground_truth import has_bar_ids

                evaluation.require_metric("extended measures are in metres")
                configs = evaluation.configs
                if not any(has_bar_ids(config) for config in configs):
                    found = f"{archive}: no masks and bar ids in {', '.join(config.name for config in configs)}"
                    raise InputError(f"{found}, expected a config that has them: measured are bars and crossings")
    if check_kinds is not None:
        check_kinds(kinds)
    with ProgressBars() as bars:
        return [
            score(archive, folder, workers=options.workers, align=align, extended=extended, progress=bars.update)
            for archive in archives
        ]


def print_verified(
    folder: DatasetFolder, verified: str = "files and views not read (rebar-bench verify does)"
) -> None:
    """Print to standard error which digests of a dataset were verified, in one line."""
    print_notice(f"dataset {folder.digest} of {folder.root}: manifest consistent; {verified}")


def add_output_file(
    parser: argparse.ArgumentParser,
    option: str,
    summary: str,
    *,
    kind: type[OutputFile] = OutputFile,
    metavar: str = "FILE",
    required: bool = False,
) -> None:
    """Add ``option``, the path of a file to write; ``-`` is standard output for ``STANDARD_OUTPUT_OPTIONS``."""

    def convert(text: str) -> OutputFile:
        if text != "-":
            return kind(text)
        if not may_be_stdout:
            allowed = " and ".join(STANDARD_OUTPUT_OPTIONS)
            raise argparse.ArgumentTypeError(
                f"- is standard output, expected the name of a file: only {allowed} can be -"
            )
        return kind(STANDARD_OUTPUT)

    may_be_stdout = option in STANDARD_OUTPUT_OPTIONS
    help_text = f"{summary}; - is standard output, and no table is printed" if may_be_stdout else summary
    parser.add_argument(option, type=convert, required=required, metavar=metavar, help=help_text)


def prints_table(options: argparse.Namespace) -> bool:
    """Return whether a command prints its table: standard output is free of the content of an output."""
    return STANDARD_OUTPUT not in vars(options).values()


def check_outputs(options: Mapping[str, object]) -> None:
    """Check the values of a command's options that are an ``OutputFile``, before any work.

    Raises ``InputError`` if one would overwrite an ``InputFile``, another output or a file of an ``InputFolder``,
    or is a folder (an ``OutputFolder``: a file), and ``OutputError`` if it or its folder cannot be written.
    Several outputs may be the same device or folder, but only one may be a pipe or standard output.
    """
    values = [value for given in options.values() for value in (given if isinstance(given, list) else [given])]
    folders = [Path(value) for value in values if isinstance(value, InputFolder)]
    methods = re.compile(r"(?<=\.py):\w+$")
    inputs = [*(Path(methods.sub("", value)) for value in values if isinstance(value, InputFile)), *folders]
    seen: dict[Path, tuple[str, OutputFile]] = {}
    for name, output in options.items():
        if not isinstance(output, OutputFile):
            continue
        option, target = f"--{name.replace('_', '-')}", Path(os.path.realpath(output))
        other, first = seen.setdefault(target, (option, output))
        is_shared = target.is_char_device() or (
            isinstance(first, OutputFolder) and isinstance(output, OutputFolder)
        )
        if other != option and not is_shared:
            raise InputError(f"{option} and {other} both name {output}, expected different files")
        for path in inputs:
            if path.exists() and target == path.resolve():
                raise InputError(f"{option} names {output}, which is an input and would be overwritten")
        for path in folders:
            if path.is_dir() and not isinstance(output, OutputArchive) and path.resolve() in target.parents:
                raise InputError(
                    f"{option} names {output}, which is inside {path}: expected a path outside the input"
                )
        if output == STANDARD_OUTPUT:
            if getattr(sys.stdout, "name", "") == os.devnull:  # ``prepare_terminal`` has opened it.
                raise InputError(f"{option} names {output}, but standard output is closed: expected an open one")
        elif isinstance(output, OutputFolder) and is_stream(output):
            raise InputError(f"{option} names {output}, which is no folder: expected a new or an existing one")
        elif isinstance(output, OutputFolder):
            _check_writable(option, output, target / "file")
        elif not is_stream(output):
            _check_writable(option, output, link_target(output).absolute())
        elif not os.access(output, os.W_OK):
            raise OutputError(f"{option} names {output}, which cannot be written to")


def _check_writable(option: str, output: Path, target: Path) -> None:
    if target.is_dir():
        raise InputError(f"{option} names {output}, which is a folder: expected a file to write")
    ancestor = next(parent for parent in target.parents if parent.exists())
    if not ancestor.is_dir():
        raise InputError(f"{option} names {output}, but {ancestor} is a file: expected a folder")
    if not os.access(ancestor, os.W_OK):
        raise OutputError(f"{option} names {output}, but {ancestor} cannot be written to")
