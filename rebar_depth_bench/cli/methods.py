"""The ``rebar-bench methods`` command."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.methods import AnyMethod, MultiViewMethod, all_methods
from rebar_depth_bench.methods.base import input_class
from rebar_depth_bench.reporting.tables import plain_text
from rebar_depth_bench.submission.declaration import METRIC

_ALL_VIEWS_NOTE = "prepares a whole config before it predicts any view"
_NEEDS_COLUMN_WIDTH = len("cam_from_world,")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add no arguments; the command has none."""
    del parser


def run(_: argparse.Namespace) -> None:
    """Print a table of the methods: summary, required columns, source, licence and untested parts."""
    table = Table(title="Methods", show_lines=True, expand=True)
    table.add_column("method", no_wrap=True)
    table.add_column("description", overflow="fold", ratio=3)
    table.add_column("needs", overflow="fold", width=_NEEDS_COLUMN_WIDTH)
    table.add_column("source, licence", overflow="fold", ratio=2)
    for name, method in all_methods().items():
        if isinstance(method, MethodError):
            table.add_row(plain_text(name), plain_text(f"cannot be used: {method}"), "", "")
            continue
        info = method.info
        label = f"{name} †" if info.uses_ground_truth else name
        table.add_row(
            plain_text(label),
            _summary_and_notes(method),
            plain_text(f"{_format_columns(info.columns)}\ninputs: {input_class(method) or '-'}"),
            plain_text(f"{info.source}\nlicence: {info.licence}"),
        )
    Console().print(table)
    Console().print("† uses ground truth; its submissions are not ranked")


def _summary_and_notes(method: AnyMethod) -> Text:
    """Return the summary, followed by dimmed notes on separate lines."""
    kind = "" if method.info.prediction == METRIC else f"predictions of the kind {method.info.prediction}"
    notes = (*((_ALL_VIEWS_NOTE,) if isinstance(method, MultiViewMethod) else ()), kind, method.info.untested_note)
    lines = [plain_text(method.info.summary), *(plain_text(f"({line})", style="dim") for line in notes if line)]
    return Text("\n").join(lines)


def _format_columns(columns: Sequence[str]) -> str:
    """Return the dataset columns, with a left/right pair merged: ``both rgb`` for ``left_rgb, right_rgb``."""
    names = set(columns)
    parts = []
    for column in columns:
        eye, _, kind = column.partition("_")
        if eye == "left" and f"right_{kind}" in names:
            parts.append(f"both {kind}")
        elif not (eye == "right" and f"left_{kind}" in names):
            parts.append(column)
    return ", ".join(parts)
