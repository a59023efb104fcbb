"""What every study shares: ``--json``, ``--csv``, ``--html``, and its page's tables in the terminal."""

from __future__ import annotations

import argparse
import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from rebar_depth_bench.files import write_bytes, write_text
from rebar_depth_bench.numbers import rounded
from rebar_depth_bench.report.study_page import PageTable, StudyPage, render_study
from rebar_depth_bench.table import csv_cell, print_whole


def add_output_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--json FILE --csv FILE --html FILE``."""
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every number as JSON")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write the table as CSV")
    parser.add_argument("--html", type=Path, metavar="FILE", help="write a self-contained page")


def write_outputs(
    options: argparse.Namespace, content: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], page: StudyPage
) -> None:
    """Write the files that are asked for, then print the page's tables and notes to standard output.

    ``rows`` are the CSV's lines, all with the same keys; none gives an empty file.
    """
    if options.json:
        write_bytes(options.json, json_bytes(content))
    if options.csv:
        write_text(options.csv, csv_text(rows))
    if options.html:
        write_text(options.html, render_study(page))
    print_page(page, Console())


def json_bytes(content: Mapping[str, Any]) -> bytes:
    """Return JSON with numbers of 12 significant digits and null for undefined ones: same input, same bytes."""
    return (json.dumps(_rounded(content), indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()


def csv_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return rows as CSV with a header, numbers as in the JSON: same input, same bytes.

    Undefined numbers are empty. A text that a spreadsheet would run as a formula gets a leading apostrophe.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerows(rows[:1])
    writer.writerows([csv_cell(_rounded(value)) for value in row.values()] for row in rows)
    return out.getvalue()


def print_page(page: StudyPage, console: Console) -> None:
    """Print title, stamps, tables and notes; no number is cut, a narrow console gets longer lines."""
    console.print(Text(page.title, style="bold"))
    console.print(Text("; ".join(f"{what}: {value}" for what, value in page.stamps), style="dim"))
    for table in page.tables:
        console.print()
        console.print(Text(table.caption, style="italic"))
        print_whole(console, _rich_table(table))
    console.print()
    for note in page.notes:
        console.print(Text(note))


def _rich_table(table: PageTable) -> RichTable:
    shown = RichTable(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0), show_edge=False)
    for index, (name, unit) in enumerate(table.heads):
        justify: Any = "left" if index == 0 else "right"
        shown.add_column(Text(f"{name}\n{unit}"), justify=justify, no_wrap=True)
    for row in table.rows:
        shown.add_row(*(Text(cell) for cell in row))
    return shown


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return rounded(value)
    if isinstance(value, Mapping):
        return {key: _rounded(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(one) for one in value]
    return value
