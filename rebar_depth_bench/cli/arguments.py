"""Arguments that several commands share, and the check of output files before a command runs."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

from rebar_depth_bench.errors import InputError

OUTPUT_OPTIONS = ("out", "json", "csv", "html", "latex", "extended_csv")


def add_archive(parser: argparse.ArgumentParser) -> None:
    """Add the positional argument of one archive."""
    parser.add_argument("archive", metavar="ARCHIVE", help="the submission's zip")


def add_data(parser: argparse.ArgumentParser) -> None:
    """Add ``--data``."""
    parser.add_argument("--data", required=True, metavar="ROOT", help="dataset folder or Hub repository id")


def add_workers(parser: argparse.ArgumentParser) -> None:
    """Add ``--workers``."""
    parser.add_argument("--workers", type=int, metavar="N", help="threads (default: one a core)")


def add_file(parser: argparse.ArgumentParser, option: str, summary: str) -> None:
    """Add an option that names a file to write."""
    parser.add_argument(option, type=Path, metavar="FILE", help=summary)


def check_outputs(options: Mapping[str, object]) -> None:
    """Raise ``InputError`` where an output would overwrite an input, another output or a file of the dataset.

    Also where it is a folder or its folder cannot be written to. ``options`` are a command's: outputs are the
    paths in ``OUTPUT_OPTIONS``, inputs all other texts and lists of texts.
    """
    outputs = {name: value for name in OUTPUT_OPTIONS if isinstance(value := options.get(name), Path)}
    given = [value for name, value in options.items() if name not in outputs]
    inputs = [Path(text) for value in given for text in _texts(value)]
    seen: dict[Path, str] = {}
    for name, output in outputs.items():
        option, target = f"--{name.replace('_', '-')}", output.resolve()
        if target in seen:
            raise InputError(f"{option} and {seen[target]} both name {output}, expected a file each")
        seen[target] = option
        for path in inputs:
            if path.exists() and target == path.resolve():
                raise InputError(f"{option} names {output}, which is read: it would be overwritten")
            if path.is_dir() and name != "out" and path.resolve() in target.parents:
                raise InputError(
                    f"{option} names {output}, which is inside {path}: expected a place outside the data"
                )
        if name != "out" or not target.is_dir():
            _check_place(option, output, target)


def _check_place(option: str, output: Path, target: Path) -> None:
    if target.is_dir():
        raise InputError(f"{option} names {output}, which is a folder: expected a file to write")
    above = next(parent for parent in target.parents if parent.exists())
    if not above.is_dir():
        raise InputError(f"{option} names {output}, but {above} is a file: expected a folder")
    if not os.access(above, os.W_OK):
        raise InputError(f"{option} names {output}, but {above} cannot be written to")


def _texts(value: object) -> Iterable[str]:
    if isinstance(value, str):
        return [value]
    return [one for one in value if isinstance(one, str)] if isinstance(value, list) else []
