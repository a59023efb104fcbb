"""Command lines of all programs: commands, exit codes, shared options, and the check of output files."""

from __future__ import annotations

import argparse
import os
import re
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from rebar_depth_bench.atomic_io import (
    STANDARD_OUTPUT,
    WRITE_ERRORS,
    is_standard_output,
    is_stream,
    link_target,
    open_descriptor,
)
from rebar_depth_bench.errors import InputError, OutputError, RebarDepthError
from rebar_depth_bench.reading import parse_number
from rebar_depth_bench.terminal import print_notice

if TYPE_CHECKING:
    from rebar_depth_bench.data.manifest import DatasetFolder

EXIT_DONE, EXIT_OTHER, EXIT_INPUT = 0, 1, 2
"""Exit codes: success, any other error, invalid input."""

MAX_SECONDS = 1e6
"""Longest duration that an option accepts, seconds; Python cannot wait for more than some 1e10."""


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


def add_expect_digest(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--expect-digest``."""
    parser.add_argument(
        "--expect-digest",
        metavar="DIGEST",
        help="refuse any other dataset than that with this ground-truth digest (sha256:...)",
    )


def print_verified(
    folder: DatasetFolder, verified: str = "files and views not read (rebar-bench verify does)"
) -> None:
    """Print to standard error which digests of a dataset were verified, in one line."""
    print_notice(f"dataset {folder.digest} of {folder.root}: manifest consistent; {verified}")


# Output files, and the check of all output paths that precedes any work.

OUTPUT_OPTIONS = ("out", "json", "csv", "html", "latex", "groups_csv", "extended_csv", "figure", "picture")
"""Names (argparse dest) of the options that are output paths."""
STANDARD_OUTPUT_OPTIONS = ("--json", "--csv")
"""Options whose file may be ``-``, standard output."""
INPUT_FILE_OPTIONS = (
    "archive",
    "detections",
    "archives",
    "first",
    "others",
    "method",
    "token_file",
    "scene_files",
)
"""Names of the options that are files to read; a method may be ``FILE.py:NAME`` or ``FILE.toml``."""
INPUT_FOLDER_OPTIONS = ("data", "predictions", "kitti", "methods", "reference")
"""Names of the options that are folders to read, or files or Hub repositories in their place."""


def add_output_file(
    parser: argparse.ArgumentParser,
    option: str,
    summary: str,
    *,
    metavar: str = "FILE",
    required: bool = False,
) -> None:
    """Add ``option``, the path of a file to write; ``-`` is standard output for ``STANDARD_OUTPUT_OPTIONS``."""
    may_be_stdout = option in STANDARD_OUTPUT_OPTIONS
    parser.add_argument(
        option,
        type=_output_path_or_stdout if may_be_stdout else _output_path,
        required=required,
        metavar=metavar,
        help=f"{summary}; - is standard output, and no table is printed" if may_be_stdout else summary,
    )


def _output_path_or_stdout(text: str) -> Path:
    return STANDARD_OUTPUT if text == "-" else Path(text)


def _output_path(text: str) -> Path:
    if text == "-":
        allowed = " and ".join(STANDARD_OUTPUT_OPTIONS)
        raise argparse.ArgumentTypeError(
            f"- is standard output, expected the name of a file: only {allowed} can be -"
        )
    return Path(text)


def prints_table(options: argparse.Namespace) -> bool:
    """Return whether a command prints its table: standard output is free of the content of an output."""
    return not any(map(is_standard_output, _outputs(vars(options)).values()))


def check_outputs(options: Mapping[str, object]) -> None:
    """Check the output paths of a command's ``options``.

    Outputs are the options in ``OUTPUT_OPTIONS``, inputs those in ``INPUT_FILE_OPTIONS`` and
    ``INPUT_FOLDER_OPTIONS``. Raises ``InputError`` if an output would overwrite an input, another output or a file
    of an input folder, or is a folder, and ``OutputError`` if it or its folder cannot be written. Several outputs
    may be the same device, but only one may be a pipe or standard output.
    """
    folders = [path for name in INPUT_FOLDER_OPTIONS for path in _paths(options.get(name))]
    files = [path for name in INPUT_FILE_OPTIONS for path in _paths(options.get(name))]
    seen: dict[Path, str] = {}
    for name, output in _outputs(options).items():
        option, target = f"--{name.replace('_', '-')}", Path(os.path.realpath(output))
        if target in seen and not target.is_char_device():
            raise InputError(f"{option} and {seen[target]} both name {output}, expected different files")
        seen[target] = option
        for path in (*files, *folders):
            if path.exists() and target == path.resolve():
                raise InputError(f"{option} names {output}, which is an input and would be overwritten")
        for path in folders:
            if path.is_dir() and name != "out" and path.resolve() in target.parents:
                raise InputError(
                    f"{option} names {output}, which is inside {path}: expected a path outside the input"
                )
        if is_stream(output):
            _check_stream(option, output)
        elif name != "out" or not target.is_dir():
            _check_writable(option, output, link_target(output).absolute())


def _outputs(options: Mapping[str, object]) -> dict[str, Path]:
    """Return the output paths of a command by the names of their options."""
    return {name: value for name in OUTPUT_OPTIONS if isinstance(value := options.get(name), Path)}


def _check_stream(option: str, output: Path) -> None:
    descriptor = open_descriptor(output)
    if descriptor is not None and not Path(f"/dev/fd/{descriptor}").exists():
        raise InputError(f"{option} names {output}, but descriptor {descriptor} is not open")
    if descriptor is None and not os.access(output, os.W_OK):
        raise OutputError(f"{option} names {output}, which cannot be written to")


def _check_writable(option: str, output: Path, target: Path) -> None:
    if target.is_dir():
        raise InputError(f"{option} names {output}, which is a folder: expected a file to write")
    ancestor = next(parent for parent in target.parents if parent.exists())
    if not ancestor.is_dir():
        raise InputError(f"{option} names {output}, but {ancestor} is a file: expected a folder")
    if not os.access(ancestor, os.W_OK):
        raise OutputError(f"{option} names {output}, but {ancestor} cannot be written to")


def _paths(value: object) -> list[Path]:
    """Return the paths of an option: one, several or none; ``FILE.py:NAME`` is a path and the name of a method."""
    values = value if isinstance(value, list) else [] if value is None else [value]
    return [Path(re.sub(r"(\.py):\w+$", r"\1", str(item))) for item in values]
