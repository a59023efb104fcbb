"""``rebar-bench methods``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods import AnyMethod, MultiViewMethod, all_methods

SUMMARY = "list the methods that come with the bench"
ALL_VIEWS = "sees all views of a config before it answers for any"
WIDEST_COLUMN_NAME = len("cam_from_world,")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments: none."""
    del parser


def run(_: argparse.Namespace) -> None:
    """Print what each method does, needs and costs, and what of it never ran here."""
    table = Table(title="Methods", show_lines=True, expand=True)
    table.add_column("method", no_wrap=True)
    table.add_column("what it does", overflow="fold", ratio=3)
    table.add_column("needs", overflow="fold", width=WIDEST_COLUMN_NAME)
    table.add_column("source, licence", overflow="fold", ratio=2)
    for name, method in all_methods().items():
        if isinstance(method, MethodError):
            table.add_row(name, f"cannot be used: {method}", "", "")
            continue
        info = method.info
        shown = f"{name} †" if info.reads_truth else name
        table.add_row(
            shown, _what_it_does(method), _needs(info.columns), f"{info.source}\nlicence: {info.licence}"
        )
    Console().print(table)
    Console().print("† is told some of the truth: its numbers stand for no instrument")


def _what_it_does(method: AnyMethod) -> Text:
    """Return the summary, and below it, dimmed, what else people should know."""
    further = (*((ALL_VIEWS,) if isinstance(method, MultiViewMethod) else ()), method.info.unexercised)
    lines = [Text(method.info.summary), *(Text(f"({line})", style="dim") for line in further if line)]
    return Text("\n").join(lines)


def _needs(columns: Sequence[str]) -> str:
    """Return the dataset's columns, those that both eyes have once: ``both rgb`` for ``left_rgb, right_rgb``."""
    others = set(columns)
    words = []
    for column in columns:
        eye, _, what = column.partition("_")
        if eye == "left" and f"right_{what}" in others:
            words.append(f"both {what}")
        elif not (eye == "right" and f"left_{what}" in others):
            words.append(column)
    return ", ".join(words)
