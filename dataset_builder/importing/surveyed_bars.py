"""Surveyed bars: the points of their axes in a CSV file, as surveyors and spreadsheets write it."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping
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
_LENGTHS = _NUMBERS[1:]
_ROLE, _DEFAULT_ROLE = "role", "surveyed"
_LINE = "line"
_DELIMITERS = ",;\t"
_MAX_PROBLEMS = 100
_MAX_BAR_ID = np.iinfo(np.uint16).max
_MAX_DIAMETER_M = 0.5
_MAX_COORDINATE_M = 1e6
_HEADER = f"the columns {', '.join(_NUMBERS)}, lengths in metres, between commas, semicolons or tabs"
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
    columns = {} if problems else _columns(text, problems)
    bars = () if problems else _bars(columns, problems)
    if not problems and not bars:
        problems.append(Problem("missing", "", "has no bars", "one or more"))
    if problems:
        raise InputError.from_problems(path, problems)
    return bars


def _columns(text: str, problems: list[Problem]) -> dict[str, list[str]]:
    """Return the cells of each column, and the number of each line; problems are added to ``problems``."""
    lines = text.splitlines()
    # Excel states the delimiter in a line before the header.
    first = next((n for n, line in enumerate(lines) if line.strip() and not line.lower().startswith("sep=")), 0)
    header = lines[first] if lines else ""
    delimiter = max(_DELIMITERS, key=header.count)
    reader = csv.reader(lines[first:], delimiter=delimiter, skipinitialspace=True, strict=True)
    try:
        rows = [(first + reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except csv.Error as error:
        problems.append(Problem("syntax", "", f"line {first + reader.line_num}: {error}", "a CSV file"))
        return {}
    names = [plain_key(name) for name in rows[0][1]] if rows else []
    places = {name: names.index(plain_key(name)) for name in (*_NUMBERS, _ROLE) if plain_key(name) in names}
    if missing := [name for name in _NUMBERS if name not in places]:
        found = f"line {first + 1} is {escape_text(header)}, without {', '.join(missing)}"
        problems.append(Problem("missing", "", found, _HEADER))
    problems += [
        Problem("duplicate", name, "occurs twice in the header", "each column once")
        for name in places
        if names.count(plain_key(name)) > 1
    ]
    columns: dict[str, list[str]] = {name: [] for name in (*places, _LINE)}
    for number, row in rows[1:]:
        cells = row if any(row[len(names) :]) else row[: len(names)]
        if len(problems) >= _MAX_PROBLEMS or not any(cells):
            continue
        if len(cells) != len(names):
            expected = f"{len(names)} as in the header; decimal commas need semicolons or tabs between the columns"
            problems.append(Problem("invalid", "", f"line {number} has {len(cells)} cells", expected))
            continue
        columns[_LINE].append(str(number))
        for name, place in places.items():
            columns[name].append(cells[place])
    if delimiter != "," and not problems:
        cells = [cell for name in _LENGTHS for cell in columns[name]]
        if any("," in cell for cell in cells) and any("." in cell for cell in cells):
            problems.append(Problem("conflict", "", "has numbers with commas and with points", "decimal points"))
        columns |= {name: [cell.replace(",", ".") for cell in columns[name]] for name in _LENGTHS}
    return columns


def _bars(columns: Mapping[str, list[str]], problems: list[Problem]) -> tuple[Bar, ...]:
    """Return the bars of the lines of a file; problems are added to ``problems``."""
    values = np.array([[parse_number(cell) for cell in columns[name]] for name in _NUMBERS])
    ids, sizes = values[0], values[1:].T
    is_id = (ids == np.round(ids)) & (ids >= 1) & (ids <= _MAX_BAR_ID)
    is_sound = is_id & np.isfinite(sizes).all(axis=1) & (sizes[:, 0] > 0)
    for is_right, expected in (
        (is_sound, f"a bar_id from 1 to {_MAX_BAR_ID}, a diameter above 0, and numbers with decimal points"),
        (~is_sound | (sizes[:, 0] <= _MAX_DIAMETER_M), f"a diameter of at most {_MAX_DIAMETER_M} m"),
        (~is_sound | (np.abs(sizes) < _MAX_COORDINATE_M).all(axis=1), _OFFSET),
    ):
        for row in np.flatnonzero(~is_right)[:_MAX_PROBLEMS].tolist():
            cells = escape_text(", ".join(columns[name][row] for name in _NUMBERS))
            problems.append(Problem("invalid", "", f"line {columns[_LINE][row]}: got {cells}", expected))
    if problems or not len(ids):
        return ()
    order = np.argsort(ids, kind="stable")
    roles = columns.get(_ROLE, [_DEFAULT_ROLE] * len(ids))
    return tuple(
        _bar(int(ids[rows[0]]), roles[rows[0]], sizes[rows], problems)
        for rows in np.split(order, np.flatnonzero(np.diff(ids[order])) + 1)
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
