"""A result as a table: in the terminal, as wide as it may be, and as tidy CSV."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rich import box
from rich.console import Console
from rich.measure import Measurement
from rich.segment import Segments
from rich.table import Table as RichTable
from rich.text import Text

from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.scoring.protocol import PROTOCOL, WITHIN_MM
from rebar_depth_bench.scoring.result import Result, Table

_UNBOUNDED = 10_000
_FORMULA_STARTS = ("=", "+", "-", "@")


@dataclass(frozen=True)
class _Group:
    """Columns that stay together, under a title that states their alignment."""

    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def print_table(result: Result, console: Console) -> None:
    """Print a row per config to ``console``: one table where it fits, else the same columns in two or three.

    No number is ever cut: a console narrower than the narrowest layout gets longer lines.
    """
    _print_line(console, _headline(result), style="bold")
    _print_line(console, _stamps(result), style="dim")
    names = [formatting.printable(name) for name in result.tables]
    for groups in _fitting_layout(names, list(result.tables.values()), console):
        console.print()
        for group in groups:
            if group.title:
                _print_line(console, group.title, style="italic")
        print_whole(console, _rich_table(names, groups))
    _print_notes(result, console)


def result_csv(result: Result) -> str:
    r"""Return the tables as CSV: a row per config, the JSON's numbers and stamps as columns, ``\n`` ends.

    Undefined numbers are empty. A text that a spreadsheet would run as a formula gets a leading apostrophe,
    and control characters in it become U+FFFD.
    """
    return results_csv([result])


def results_csv(results: Sequence[Result]) -> str:
    """Return the tables of several results as one CSV, as ``result_csv`` spells them."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(_csv_header())
    for result in results:
        content = result.to_dict()
        rows = [_csv_row(content, name, table) for name, table in content["tables"].items()]
        writer.writerows([csv_cell(value) for value in row] for row in rows)
    return out.getvalue()


def _headline(result: Result) -> str:
    return f"{formatting.printable(result.method)}, protocol {PROTOCOL}"


def _stamps(result: Result) -> str:
    digest = formatting.short_digest(result.dataset_digest)
    return (
        f"dataset {formatting.printable(result.dataset_version)} ({digest}), "
        f"archive {formatting.short_digest(result.submission_sha256)}, software {result.software_version}"
    )


def _print_line(console: Console, line: str, style: str = "") -> None:
    """Print text as it is: no markup, no highlighting of numbers, wrapped at words."""
    console.print(Text(line, style=style))


def print_whole(console: Console, table: RichTable) -> None:
    """Print a table at its own width even where the console is narrower: rich would cut numbers."""
    width = _width(table, console)
    options = console.options.update(width=width, max_width=width)
    console.print(Segments(list(console.render(table, options))), soft_wrap=True, end="")


def _print_notes(result: Result, console: Console) -> None:
    console.print()
    _print_line(
        console, "Means over views; s: median over views. z: truth, p: prediction. ↓ ↑: which way is better."
    )
    for name, table in result.tables.items():
        reasons = formatting.unranked_reasons(table)
        if reasons:
            _print_line(
                console, f"{formatting.printable(name)}: not ranked: {'; '.join(reasons)}.", style="yellow"
            )
    if formatting.has_dash(row for group in _groups(list(result.tables.values())) for row in group.rows):
        _print_line(console, formatting.DASH_NOTE)


def _groups(tables: Sequence[Table]) -> tuple[_Group, _Group, _Group, _Group]:
    """Return the columns of coverage and rank, native, scaled, and tolerances."""
    metric_heads = tuple(f"{name} {better}\n{unit}" for name, unit, better in formatting.METRIC_HEADS)
    return (
        _Group(
            "",
            ("views\nscored\n/all", "cover-\nage ↑\n%", "ranked\n"),
            tuple(
                (
                    f"{one.views_scored}/{one.views}",
                    formatting.coverage_percent(one.coverage),
                    "yes" if one.ranked else "no",
                )
                for one in tables
            ),
        ),
        _Group(
            formatting.NATIVE_TITLE,
            tuple(f"native\n{head}" for head in metric_heads),
            tuple(tuple(formatting.metric_cells(one.native)) for one in tables),
        ),
        _Group(
            formatting.SCALED_TITLE,
            (*(f"scaled\n{head}" for head in metric_heads), "scale\ns\n"),
            tuple(
                (*formatting.metric_cells(one.scaled), formatting.scale_cell(one.scale_median)) for one in tables
            ),
        ),
        _Group(
            formatting.WITHIN_TITLE,
            tuple(f"within\n{t} mm\n% ↑" for t in WITHIN_MM),
            tuple(tuple(formatting.within_cells(one.within_mm)) for one in tables),
        ),
    )


def _fitting_layout(names: Sequence[str], tables: Sequence[Table], console: Console) -> list[list[_Group]]:
    """Return the groups of each table to print: as few tables as the console's width allows."""
    base, native, scaled, within = _groups(tables)
    layouts = [
        [[base, native, scaled, within]],
        [[native, scaled], [base, within]],
        [[base, native], [scaled], [within]],
    ]
    for layout in layouts[:-1]:
        if all(_width(_rich_table(names, groups), console) <= console.width for groups in layout):
            return layout
    return layouts[-1]


def _rich_table(names: Sequence[str], groups: Sequence[_Group]) -> RichTable:
    table = RichTable(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0), show_edge=False)
    heads = [head for group in groups for head in group.heads]
    lines = max(head.count("\n") for head in heads)
    table.add_column(_header("config", lines), no_wrap=True)
    for head in heads:
        table.add_column(_header(head, lines), justify="right", no_wrap=True)
    for index, name in enumerate(names):
        table.add_row(Text(name), *(Text(cell) for group in groups for cell in group.rows[index]))
    return table


def _header(head: str, lines: int) -> Text:
    """Return a heading of ``lines`` + 1 lines, its own at the bottom."""
    return Text("\n" * (lines - head.count("\n")) + head)


def _width(table: RichTable, console: Console) -> int:
    """Return the width at which nothing in ``table`` is folded or cut."""
    return Measurement.get(console, console.options.update(max_width=_UNBOUNDED), table).maximum


def _csv_header() -> list[str]:
    return [
        *("protocol", "method", "config", *number_heads()),
        *("dataset_digest", "dataset_version", "submission_sha256", "software_version"),
    ]


def _csv_row(content: dict[str, Any], name: str, table: dict[str, Any]) -> list[Any]:
    """Return one config's cells in the header's order, from the objects of the result's JSON."""
    return [
        *(content["protocol"], content["submission"]["method"], name),
        *number_cells(table),
        *(content["dataset"]["digest"], content["dataset"]["version"]),
        *(content["submission"]["sha256"], content["software"]["version"]),
    ]


def number_heads() -> list[str]:
    """Return the CSV's heads of a config's numbers."""
    metrics = ("abs_rel", "rmse_cm", "mae_cm", "delta1")
    return [
        *("views", "views_scored", "coverage", "ranked"),
        *(f"native_{name}" for name in metrics),
        *(f"scaled_{name}" for name in metrics),
        "scale_median",
        *(f"within_{t}mm" for t in WITHIN_MM),
    ]


def number_cells(table: Mapping[str, Any]) -> list[Any]:
    """Return a config's numbers, ``number_heads`` by ``number_heads``, from its table in the result's JSON."""
    return [
        *(table[key] for key in ("views", "views_scored", "coverage", "ranked")),
        *table["native"].values(),
        *table["scaled"].values(),
        table["scale_median"],
        *table["within_mm"].values(),
    ]


def csv_cell(value: str | float | bool | None) -> str:
    """Return a value as a CSV cell: empty for None, no formula, no control characters."""
    if value is None:
        return ""
    if isinstance(value, str):
        clean = formatting.printable(value, limit=_UNBOUNDED)
        return f"'{clean}" if clean.startswith(_FORMULA_STARTS) else clean
    return json.dumps(value)
