"""Result tables in the terminal, adapted to its width, and as tidy CSV."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rich import box
from rich.console import Console
from rich.measure import Measurement
from rich.segment import Segments
from rich.table import Table as RichTable
from rich.text import Text

from rebar_depth_bench.errors import printable
from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.scoring.columns import (
    COVERAGE,
    NATIVE,
    ONE_PIXEL,
    RANK_ERROR,
    SCALE,
    SCALED,
    SCALED_CONSTANT,
    VIEWS_SCORED,
    WITHIN,
    Column,
    texts,
    with_reference,
)
from rebar_depth_bench.scoring.frames import tables_frame
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.scoring.table import Table
from rebar_depth_bench.terminal import terminal_text

if TYPE_CHECKING:
    from pandas import DataFrame

_UNBOUNDED = 10_000
_FORMULA_STARTS = ("=", "+", "-", "@")


@dataclass(frozen=True)
class _ColumnGroup:
    """Columns that are printed together, under a title that states their alignment."""

    title: str
    columns: Sequence[Column]

    def cells(self, table: Table) -> list[str]:
        """Return the cells of a config; a rank error that does not rank is marked."""
        marks = ["‡" if column is RANK_ERROR and not table.ranked else "" for column in self.columns]
        return [text + mark for text, mark in zip(texts(self.columns, table), marks, strict=True)]


@dataclass(frozen=True)
class _Row:
    """Row of a config or of a group of its views; ``references`` are rows of reference errors below it."""

    name: str
    table: Table
    references: Sequence[tuple[str, list[str], list[str]]] = ()


_BASE = _ColumnGroup("", [VIEWS_SCORED, COVERAGE, RANK_ERROR])
_NATIVE = _ColumnGroup(formatting.NATIVE_TITLE, NATIVE)
_SCALED = _ColumnGroup(formatting.SCALED_TITLE, [*SCALED, SCALE])
_WITHIN = _ColumnGroup(formatting.WITHIN_TITLE, WITHIN)
_LAYOUTS = (
    [[_BASE, _NATIVE, _SCALED, _WITHIN]],
    [[_NATIVE, _SCALED], [_BASE, _WITHIN]],
    [[_BASE, _NATIVE], [_SCALED], [_WITHIN]],
)
"""Column groups of each table to print, from the widest to the narrowest layout."""

_GROUP_NATIVE, _GROUP_SCALED = (_ColumnGroup("", with_reference(columns)) for columns in (NATIVE, SCALED))
_GROUP_ONE_PIXEL = _ColumnGroup("", ONE_PIXEL)
_GROUP_CONSTANT = _ColumnGroup("", [*SCALED_CONSTANT, SCALE])
_GROUP_LAYOUTS = (
    [[_BASE, _GROUP_NATIVE, _GROUP_ONE_PIXEL, _GROUP_SCALED, _GROUP_CONSTANT]],
    [[_BASE, _GROUP_NATIVE, _GROUP_ONE_PIXEL], [_GROUP_SCALED, _GROUP_CONSTANT]],
)
"""Column groups of the tables of groups of views."""


def print_table(result: Result, console: Console) -> None:
    """Print one row per config, followed by its reference errors: in one table if it fits, else in two or three.

    The groups of views of a config with splits follow, one row per group. Numbers are never truncated: a console
    narrower than the narrowest layout gets longer lines.
    """
    _print_line(console, _headline(result), style="bold")
    _print_line(console, _provenance(result), style="dim")
    _print_line(console, formatting.declaration_text(result.declared), style="dim")
    config_rows = _config_rows(result.tables)
    for groups in _fitting_layout(config_rows, console, _LAYOUTS):
        console.print()
        for group in groups:
            if group.title:
                _print_line(console, group.title, style="italic")
        print_unwrapped(console, _rich_table(config_rows, groups))
    for config, table in result.tables.items():
        if table.groups:
            _print_groups(config, table, console)
    _print_notes(result, console)


def result_csv(result: Result) -> str:
    r"""Return the tables as CSV with one row per config and ``\n`` line ends.

    Columns are the JSON's numbers, the ends of their intervals, and provenance. Undefined numbers are empty. Text
    that a spreadsheet would execute as a formula gets a leading apostrophe, and control characters become U+FFFD.
    """
    return results_csv([result])


def groups_csv(result: Result) -> str:
    """Return the tables of groups of views as CSV, one row per group, in the format of ``result_csv``."""
    return frame_csv(result.to_pandas("groups"))


def results_csv(results: Sequence[Result]) -> str:
    """Return the tables of several results as one CSV, in the format of ``result_csv``."""
    return frame_csv(tables_frame(results))


def _headline(result: Result) -> str:
    return f"{printable(result.method)}, protocol {result.protocol}"


def _provenance(result: Result) -> str:
    digest = formatting.short_digest(result.dataset.digest)
    return (
        f"dataset {printable(result.dataset.version)} ({digest}), "
        f"archive {formatting.short_digest(result.submission.sha256)}, software {result.software.version}"
    )


def _print_line(console: Console, line: str, style: str = "") -> None:
    """Print plain text, wrapped at words, without markup or highlighting of numbers."""
    console.print(plain_text(line, style))


def plain_text(text: str, style: str = "") -> Text:
    """Return text for the terminal, without markup; control characters of names in it are shown as escapes."""
    return Text(terminal_text(text), style=style)


def print_unwrapped(console: Console, table: RichTable) -> None:
    """Print a table at its natural width even if the console is narrower, because rich would truncate numbers."""
    width = _width(table, console)
    options = console.options.update(width=width, max_width=width)
    console.print(Segments(list(console.render(table, options))), soft_wrap=True, end="")


def _print_notes(result: Result, console: Console) -> None:
    console.print()
    _print_line(
        console, "Means over views; s: median over views. z: truth, p: prediction. ↓ lower, ↑ higher is better."
    )
    _print_line(console, f"{formatting.RANK_ERROR_NOTE} {formatting.REFERENCE_NOTE} ‡: not ranked.")
    for name, table in result.tables.items():
        for note in (*formatting.table_notes(table), *formatting.reference_findings(table)):
            _print_line(console, f"{printable(name)}: {note}", style="yellow")
    if any(table.groups for table in result.tables.values()):
        _print_line(console, f"{formatting.GROUP_NOTE} Intervals: in JSON and the report.")
    [all_groups] = _LAYOUTS[0]
    if formatting.has_dash(group.cells(table) for group in all_groups for table in result.tables.values()):
        _print_line(console, formatting.DASH_NOTE)


def _config_rows(tables: Mapping[str, Table]) -> list[_Row | str]:
    return [
        _Row(formatting.config_title(name, table.split), table, formatting.reference_rows([("", table)]))
        for name, table in tables.items()
    ]


def _print_groups(config: str, table: Table, console: Console) -> None:
    """Print the groups of views of a config, a section for each grouping."""
    rows: list[_Row | str] = []
    for grouping, groups_of_views in table.groups.items():
        rows.append(formatting.grouping_title(grouping))
        rows += [_Row(f"  {printable(group)}", of_group) for group, of_group in groups_of_views.items()]
    console.print()
    _print_line(console, f"{formatting.config_title(config, table.split)}: groups of views", style="bold")
    for groups in _fitting_layout(rows, console, _GROUP_LAYOUTS):
        console.print()
        print_unwrapped(console, _rich_table(rows, groups, "group"))


def _fitting_layout(
    rows: Sequence[_Row | str], console: Console, layouts: Sequence[list[list[_ColumnGroup]]]
) -> list[list[_ColumnGroup]]:
    """Return the layout with as few tables as the console's width allows."""
    for layout in layouts[:-1]:
        if all(_width(_rich_table(rows, groups), console) <= console.width for groups in layout):
            return layout
    return layouts[-1]


def _rich_table(rows: Sequence[_Row | str], groups: Sequence[_ColumnGroup], head: str = "config") -> RichTable:
    """Return the table of rows; a text among the rows is the heading of a section."""
    table = RichTable(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0), show_edge=False)
    heads = [column.head for group in groups for column in group.columns]
    lines = max(head.count("\n") for head in heads)
    table.add_column(_header(head, lines), no_wrap=True)
    for column_head in heads:
        table.add_column(_header(column_head, lines), justify="right", no_wrap=True)
    for row in rows:
        if isinstance(row, str):
            table.add_section()
            table.add_row(plain_text(row, style="italic"))
            continue
        cells = [cell for group in groups for cell in group.cells(row.table)]
        table.add_row(*map(plain_text, [row.name, *cells]))
        for title, native, scaled in row.references:
            errors = {_NATIVE.title: native, _SCALED.title: scaled}
            filled = [errors.get(group.title, []) for group in groups]
            if any(map(any, filled)):
                cells = [
                    cell
                    for group, shown in zip(groups, filled, strict=True)
                    for cell in [*shown, *[""] * (len(group.columns) - len(shown))]
                ]
                table.add_row(*map(plain_text, [f"  {title}", *cells]), style="dim")
    return table


def _header(head: str, lines: int) -> Text:
    """Return a heading padded at the top with empty lines to ``lines`` + 1 lines."""
    return Text("\n" * (lines - head.count("\n")) + head)


def _width(table: RichTable, console: Console) -> int:
    """Return the width at which nothing in ``table`` is wrapped or truncated, characters."""
    return Measurement.get(console, console.options.update(max_width=_UNBOUNDED), table).maximum


def frame_csv(frame: DataFrame) -> str:
    r"""Return a frame as CSV with ``\n`` line ends; undefined numbers are empty."""
    if frame.columns.empty:
        return ""
    cells = frame.astype(object).where(frame.notna(), None)
    return csv_text([list(frame.columns), *cells.itertuples(index=False, name=None)])


def csv_text(rows: Iterable[Iterable[str | float | bool | None]]) -> str:
    r"""Return rows of values, the first of which is the header, as CSV with ``\n`` line ends."""
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows([csv_cell(value) for value in row] for row in rows)
    return out.getvalue()


def csv_cell(value: str | float | bool | None) -> str:
    """Return a value as a CSV cell: empty for None, text without formulas and control characters."""
    if value is None:
        return ""
    if isinstance(value, str):
        clean = printable(value, limit=_UNBOUNDED)
        return f"'{clean}" if clean.startswith(_FORMULA_STARTS) else clean
    return json.dumps(value)
