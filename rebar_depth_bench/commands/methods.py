"""``rebar-bench methods``."""

from __future__ import annotations

import argparse

from rich.console import Console
from rich.table import Table

from rebar_depth_bench.methods import METHODS

SUMMARY = "list the methods that come with the bench"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments: none."""
    del parser


def run(_: argparse.Namespace) -> None:
    """Print what each method does, needs and costs."""
    table = Table(title="Methods")
    for heading in ("method", "what it does", "needs", "source", "licence"):
        table.add_column(heading, overflow="fold")
    for method in METHODS.values():
        info = method.info
        table.add_row(info.name, info.summary, ", ".join(info.columns), info.source, info.licence)
    Console().print(table)
