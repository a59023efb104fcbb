"""Surveyed bars: the points of their axes in a CSV file, as surveyors and spreadsheets write it."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.base.errors import InputError, Problem, escape_text
from rebar_depth_bench.base.limits import TABLE_BYTES
from rebar_depth_bench.base.reading import decode_text, parse_number, read_file
from rebar_depth_bench.captures.fields import plain_key
from rebar_depth_bench.data.bars import Bar

_NUMBERS = ("bar_id", "diameter_m", "x_m", "y_m", "z_m")
_ROLE, _DEFAULT_ROLE = "role", "surveyed"
_COLUMNS = {plain_key(name): name for name in (*_NUMBERS, _ROLE)}
_DELIMITERS = ",;\t"
_MAX_PROBLEMS = 100
_MAX_BAR_ID = np.iinfo(np.uint16).max
_MAX_DIAMETER_M = 0.5
_MAX_COORDINATE_M = 1e6
_HEADER = f"the columns {', '.join(_NUMBERS)}, lengths in metres, between commas, semicolons or tabs"
_LINE = f"a bar_id from 1 to {_MAX_BAR_ID}, a diameter up to {_MAX_DIAMETER_M} m, and numbers with decimal points"
_OFFSET = (
    f"less than {_MAX_COORDINATE_M:g} m: subtract one offset from all points of this file and from all camera"
    " centres of the poses (of a pose cam_from_world with R and t, add R times the offset to t)"
)


def read_bars_file(path: Path) -> tuple[Bar, ...]:
    """Return the bars of a CSV file with the columns bar_id, diameter_m, x_m, y_m, z_m and, if wanted, role.

    Each line is a point of an axis, in order. Commas, semicolons or tabs are between the columns; beside the
    latter two, numbers may have decimal commas. Raises ``InputError`` with the first problems and their lines.
    """
    content = read_file(path, TABLE_BYTES, "a CSV file of bars", InputError)
    text, problems = decode_text(content)
    rows = [] if problems else _rows(text, problems)
    bars = () if problems else _bars(rows, problems)
    if not problems and not bars:
        problems.append(Problem("missing", "", "has no bars", "one or more"))
    if problems:
        raise InputError.from_problems(path, problems)
    return bars


def _rows(text: str, problems: list[Problem]) -> list[tuple[int, dict[str, str]]]:
    """Return the number of each line and its cells by column; problems are added to ``problems``."""
    lines = text.splitlines()
    # Excel states the delimiter in a line before the header.
    first = next((n for n, line in enumerate(lines) if line.strip() and not line.lower().startswith("sep=")), 0)
    header = lines[first] if lines else ""
    delimiter = max(_DELIMITERS, key=header.count)
    reader = csv.reader(lines[first:], delimiter=delimiter, skipinitialspace=True, strict=True)
    try:
        read = [(first + reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except csv.Error as error:
        problems.append(Problem("syntax", "", f"line {first + reader.line_num}: {error}", "a CSV file"))
        return []
    names = [_COLUMNS.get(plain_key(name), "") for name in read[0][1]] if read else []
    if wrong := [name for name in _NUMBERS if names.count(name) != 1]:
        found = f"line {first + 1} is {escape_text(header)}, without one {', one '.join(wrong)}"
        problems.append(Problem("missing", "", found, _HEADER))
        return []
    read = [(number, cells) for number, cells in read[1:] if any(cells)]
    for number, cells in read:
        if len(problems) < _MAX_PROBLEMS and (len(cells) < len(names) or any(cells[len(names) :])):
            expected = f"{len(names)} as in the header; decimal commas need semicolons or tabs between the columns"
            problems.append(Problem("invalid", "", f"line {number} has {len(cells)} cells", expected))
    rows = [(number, dict(zip(names, cells, strict=False))) for number, cells in read]
    if delimiter != "," and not problems:
        numbers = [row[name] for _, row in rows for name in _NUMBERS[1:]]
        if any("," in cell for cell in numbers) and any("." in cell for cell in numbers):
            problems.append(Problem("conflict", "", "has numbers with commas and with points", "decimal points"))
        for _, row in rows:
            row |= {name: row[name].replace(",", ".") for name in _NUMBERS[1:]}
    return rows


def _bars(rows: Sequence[tuple[int, Mapping[str, str]]], problems: list[Problem]) -> tuple[Bar, ...]:
    """Return the bars of the lines of a file; problems are added to ``problems``."""
    values = np.array([[parse_number(row[name]) for name in _NUMBERS] for _, row in rows]).reshape(-1, 5)
    ids, sizes = values[:, 0], values[:, 1:]
    is_sound = (ids == np.round(ids)) & (ids >= 1) & (ids <= _MAX_BAR_ID) & np.isfinite(sizes).all(axis=1)
    is_sound &= (sizes[:, 0] > 0) & (sizes[:, 0] <= _MAX_DIAMETER_M)
    is_near = (np.abs(sizes) < _MAX_COORDINATE_M).all(axis=1)
    for k in np.flatnonzero(~(is_sound & is_near))[:_MAX_PROBLEMS].tolist():
        cells = escape_text(", ".join(rows[k][1][name] for name in _NUMBERS))
        expected = _OFFSET if is_sound[k] else _LINE
        problems.append(Problem("invalid", "", f"line {rows[k][0]}: got {cells}", expected))
    if problems or not len(ids):
        return ()
    order = np.argsort(ids, kind="stable")
    return tuple(
        _bar(int(ids[of_bar[0]]), rows[of_bar[0]][1].get(_ROLE, _DEFAULT_ROLE), sizes[of_bar], problems)
        for of_bar in np.split(order, np.flatnonzero(np.diff(ids[order])) + 1)
    )


def _bar(bar_id: int, role: str, sizes: Float64[ndarray, "n 4"], problems: list[Problem]) -> Bar:
    """Return a bar of the diameter and the points in ``sizes``; problems are added to ``problems``."""
    diameters_m, axis_m = sizes[:, 0], sizes[:, 1:]
    if len(set(diameters_m.tolist())) > 1:
        problems.append(Problem("conflict", f"bar {bar_id}", "has several diameters", "one"))
    if len(axis_m) < 2 or not np.diff(axis_m, axis=0).any(axis=1).all():
        problems.append(
            Problem("invalid", f"bar {bar_id}", f"has {len(axis_m)} points", "two or more, no two the same")
        )
    if re.search(r"[\x00-\x1f\x7f-\x9f]", role):
        problems.append(Problem("invalid", f"bar {bar_id}", f"has the role {escape_text(role)}", "printable text"))
    points = tuple((float(x), float(y), float(z)) for x, y, z in axis_m)
    return Bar(bar_id, role, float(diameters_m[0]), points)
