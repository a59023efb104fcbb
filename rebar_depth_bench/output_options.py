"""Options that name output files, and the check of all output paths that precedes any work."""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Mapping
from pathlib import Path

from rebar_depth_bench.atomic_io import (
    STANDARD_OUTPUT,
    is_standard_output,
    is_stream,
    link_target,
    open_descriptor,
)
from rebar_depth_bench.errors import InputError, OutputError

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
