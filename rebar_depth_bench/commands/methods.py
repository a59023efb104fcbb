"""``rebar-bench methods``."""

from __future__ import annotations

import argparse

from rich.console import Console
from rich.table import Table

from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods import all_methods

SUMMARY = "list the methods that come with the bench"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments: none."""
    del parser


def run(_: argparse.Namespace) -> None:
    """Print what each method does, needs and costs."""
    table = Table(title="Methods")
    table.add_column("method", no_wrap=True)
    for heading in ("what it does", "needs", "source", "licence"):
        table.add_column(heading, overflow="fold")
    for name, method in all_methods().items():
        if isinstance(method, MethodError):
            table.add_row(name, f"cannot be used: {method}", "", "", "")
            continue
        info = method.info
        table.add_row(name, info.summary, ", ".join(info.columns), info.source, info.licence)
    Console().print(table)
