"""Surveyed bars: a CSV file with the points of their axes."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.errors import InputError, Problem, escape_text, exception_summary
from rebar_depth_bench.limits import TABLE_BYTES
from rebar_depth_bench.reading import read_file

_NUMBERS = ("diameter_m", "x_m", "y_m", "z_m")
_MAX_BAR_ID = np.iinfo(np.uint16).max
_DEFAULT_ROLE = "surveyed"


def read_bars_file(path: Path) -> tuple[Bar, ...]:
    """Return the bars of a CSV file with the columns bar_id, diameter_m, x_m, y_m, z_m and, if wanted, role.

    Each line is a point of an axis, in order. Raises ``InputError`` with all problems, which name the line.
    """
    import pandas as pd

    content = read_file(path, TABLE_BYTES, "a CSV file of bars", InputError)
    try:
        table = pd.read_csv(io.BytesIO(content), dtype=str, keep_default_na=False, skipinitialspace=True)
    except ValueError as error:  # Errors of pandas' parser and of decoding are ValueErrors.
        problem = Problem("syntax", "", f"no CSV file: {escape_text(exception_summary(error))}")
        raise InputError.from_problems(path, [problem]) from None
    problems = [
        Problem("missing", name, "missing", "a column") for name in ("bar_id", *_NUMBERS) if name not in table
    ]
    if problems:
        raise InputError.from_problems(path, problems)
    numbers = table[["bar_id", *_NUMBERS]].apply(pd.to_numeric, errors="coerce").to_numpy(np.float64)
    ids, sizes = numbers[:, 0], numbers[:, 1:]
    sound_id = np.isfinite(ids) & (ids == np.round(ids)) & (ids >= 1) & (ids <= _MAX_BAR_ID)
    sound = sound_id & np.isfinite(sizes).all(axis=1) & (sizes[:, 0] > 0) & (np.abs(sizes) < 1e6).all(axis=1)
    for row in np.flatnonzero(~sound):
        expected = f"a bar_id from 1 to {_MAX_BAR_ID}, a diameter above 0 and finite coordinates"
        found = f"line {row + 2}: got {escape_text(','.join(table.iloc[row]))}"
        problems.append(Problem("invalid", "", found, expected))
    roles = table.get("role")
    bars = []
    for bar_id in [] if problems else np.unique(ids).astype(int).tolist():
        rows = np.flatnonzero(ids == bar_id)
        role = _DEFAULT_ROLE if roles is None else roles.iloc[rows[0]]
        bars.append(_bar(bar_id, role, sizes[rows], problems))
    if not problems and not bars:
        problems.append(Problem("missing", "", "has no bars", "one or more"))
    if problems:
        raise InputError.from_problems(path, problems)
    return tuple(bars)


def _bar(bar_id: int, role: str, sizes: Float64[ndarray, "n 4"], problems: list[Problem]) -> Bar:
    """Return a bar of the diameter and the points in ``sizes``; problems are added to ``problems``."""
    diameters_m, axis_m = sizes[:, 0], sizes[:, 1:]
    if len(set(diameters_m.tolist())) > 1:
        problems.append(Problem("conflict", f"bar {bar_id}", "has several diameters", "one"))
    if len(axis_m) < 2 or not np.diff(axis_m, axis=0).any(axis=1).all():
        problems.append(
            Problem("invalid", f"bar {bar_id}", f"has {len(axis_m)} points", "two or more, no two the same")
        )
    points = tuple((float(x), float(y), float(z)) for x, y, z in axis_m)
    return Bar(bar_id, role, float(diameters_m[0]), points)
