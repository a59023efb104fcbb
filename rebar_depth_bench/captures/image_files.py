"""Image files of a capture: names, sizes, and decoding of 8-bit pictures."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from jaxtyping import UInt8
from numpy import ndarray

from rebar_depth_bench.captures.image_header import read_image_shape
from rebar_depth_bench.data.codecs import decode
from rebar_depth_bench.errors import EntryError, InputError, Problem, escape_text
from rebar_depth_bench.limits import CELL_BYTES
from rebar_depth_bench.reading import read_file

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
NAME_RULE = "a name of 1 to 100 letters, digits, . _ -"


def read_image(path: Path, grid: tuple[int, int]) -> UInt8[ndarray, "h w 3"]:
    """Return an 8-bit image of ``grid`` (height, width) as RGB.

    Raises ``InputError`` if it cannot be read or decoded, or has another size or more bits.
    """
    content = read_file(path, CELL_BYTES, "an image", InputError)
    try:
        return decode("rgb", content, grid)
    except Exception as error:  # Pillow raises many types, which depend on the damage.
        reason = escape_text(str(error) or type(error).__name__)
        raise InputError(f"{path}: cannot be decoded: {reason}, expected an 8-bit PNG or JPEG image") from error


def entry_name(file: Path) -> str:
    """Return the location of an image in the capture, for error messages."""
    return escape_text(f"{file.parent.name}/{file.name}")


def image_files(folder: Path, problems: list[Problem]) -> dict[str, Path]:
    """Return the image files of a folder by stem; append the problems of their names to ``problems``."""
    if not folder.is_dir():
        problems.append(Problem("missing", f"{folder.name}/", "no such folder"))
        return {}
    if not os.access(folder, os.R_OK | os.X_OK):
        problems.append(Problem("unreadable", f"{folder.name}/", "the folder cannot be read"))
        return {}
    files: dict[str, Path] = {}
    for file in sorted(folder.iterdir()):
        if file.suffix.lower() not in IMAGE_SUFFIXES or file.is_dir():
            continue
        if file.stem in files:
            problems.append(Problem("duplicate", entry_name(file), "the name occurs twice", "one image per view"))
        if not NAME.fullmatch(file.stem):
            problems.append(Problem("name", entry_name(file), "invalid name", NAME_RULE))
        files[file.stem] = file
    return files


def common_shape(images: Sequence[Path], problems: list[Problem]) -> tuple[int, int] | None:
    """Return (height, width) of the first readable image; add a problem for each of another size or unreadable."""
    shape: tuple[int, int] | None = None
    for file in images:
        try:
            height, width = read_image_shape(file)
        except EntryError as error:
            problems += [replace(problem, where=entry_name(file)) for problem in error.problems]
            continue
        shape = shape or (height, width)
        if (height, width) != shape:
            expected = f"{shape[1]} x {shape[0]} as the first"
            problems.append(Problem("invalid", entry_name(file), f"is {width} x {height}", expected))
    return shape
