"""Columns of a file of detections, and its content as arrays in the order of the file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.errors import Problem

VIEW_ID = "view_id"
CAMERA, WORLD = ("x", "y", "z"), ("world_x", "world_y", "world_z")
NORMAL = ("nx", "ny", "nz")
CONFIDENCE = "confidence"
NUMBERS = (*CAMERA, *WORLD, *NORMAL, CONFIDENCE)
"""Columns of numbers; further columns of a file are not read."""

METADATA = ("method", "inputs", "uses_ground_truth")
"""Keys of a file's metadata: of the schema of a Parquet file, or lines ``# key: value`` at the start of a CSV."""

MAX_REPORTED = 1000
"""Number of problems of a file that are kept; a file may have one in every row."""


@dataclass(frozen=True, eq=False)
class RawDetections:
    """Content of a file of detections: ids of views, numbers by column, and metadata as text.

    ``lines`` are the numbers of the rows in messages: lines of a CSV, or rows of a Parquet file, from 1.
    ``faulty`` are the positions of rows whose problems have been reported.
    """

    view_ids: Sequence[str]
    numbers: Mapping[str, Float64[ndarray, " n"]]
    lines: Sequence[int]
    metadata: Mapping[str, str]
    row_noun: str
    faulty: frozenset[int] = frozenset()


@dataclass(frozen=True, eq=False)
class Detections:
    """Detections of crossings, n rows: points in metres in the frame ``is_world`` says, of the view or the world.

    ``normal`` has unit vectors in the same frame, NaN where none is given; ``confidence`` is 1 where none is
    given.
    """

    view_ids: Sequence[str]
    is_world: bool
    point_m: Float64[ndarray, "n 3"]
    normal: Float64[ndarray, "n 3"]
    confidence: Float64[ndarray, " n"]
    has_confidence: bool


def column_problems(names: Sequence[str]) -> list[Problem]:
    """Return the problems of the columns of a file."""
    problems = [
        Problem("duplicate", name, "the column occurs more than once", "each column once")
        for name in (VIEW_ID, *NUMBERS)
        if names.count(name) > 1
    ]
    if VIEW_ID not in names:
        problems.append(Problem("missing", VIEW_ID, "the column is missing", "the id of the view of each row"))
    present = [columns for columns in (CAMERA, WORLD) if any(name in names for name in columns)]
    either = "x, y, z (left camera) or world_x, world_y, world_z"
    if len(present) == 2:
        problems.append(Problem("conflict", "", "the file has columns of both frames", either))
    elif not present:
        problems.append(Problem("missing", "", "the file has no columns of positions", either))
    for columns in (*present, *([NORMAL] if any(name in names for name in NORMAL) else [])):
        absent = [name for name in columns if name not in names]
        if absent and len(present) < 2:
            expected = f"all of {', '.join(columns)}"
            problems.append(Problem("missing", absent[0], "the column is missing", expected))
    return problems


def checked_detections(raw: RawDetections, problems: list[Problem]) -> Detections:
    """Return the detections of a file with valid columns; problems of its values are added to ``problems``."""
    is_world = WORLD[0] in raw.numbers
    point_m = np.column_stack([raw.numbers[name] for name in (WORLD if is_world else CAMERA)]).reshape(-1, 3)
    not_finite = np.flatnonzero(~np.isfinite(point_m).all(axis=1))
    problems += _problems(raw, not_finite, "the position is not finite", "three numbers, metres")
    confidence = raw.numbers.get(CONFIDENCE)
    if confidence is not None:
        not_finite = np.flatnonzero(~np.isfinite(confidence))
        problems += _problems(raw, not_finite, "the confidence is not finite", "a number")
    return Detections(
        raw.view_ids,
        is_world,
        point_m,
        _unit_normals(raw, problems),
        np.ones(len(point_m)) if confidence is None else confidence,
        confidence is not None,
    )


def _unit_normals(raw: RawDetections, problems: list[Problem]) -> Float64[ndarray, "n 3"]:
    count = len(raw.view_ids)
    if NORMAL[0] not in raw.numbers:
        return np.full((count, 3), np.nan)
    normal = np.column_stack([raw.numbers[name] for name in NORMAL]).reshape(-1, 3)
    absent = np.isnan(normal).all(axis=1)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        length = np.linalg.norm(normal, axis=1)
        invalid = ~absent & ~((length > 0) & (length < np.inf))
        unit = normal / length[:, None]
    expected = "three numbers that are not all 0, or none"
    problems += _problems(raw, np.flatnonzero(invalid), "the normal has no direction", expected)
    return np.where(invalid[:, None], np.nan, unit)


def _problems(raw: RawDetections, rows: ndarray, found: str, expected: str) -> list[Problem]:
    """Return a problem for each of the first rows whose problems are not known yet."""
    new = [row for row in rows[:MAX_REPORTED].tolist() if row not in raw.faulty]
    return [Problem("invalid", f"{raw.row_noun} {raw.lines[row]}", found, expected) for row in new]
