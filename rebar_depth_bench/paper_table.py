"""Several results side by side in the terminal, in the layout of the paper's Table I."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from rich import box
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from rebar_depth_bench import wording
from rebar_depth_bench.protocol import PROTOCOL
from rebar_depth_bench.published import load_published, paper_scene, published_rows
from rebar_depth_bench.result import Result, Table
from rebar_depth_bench.version import software_version

_HEADS = ("RMSE, cm ↓", "AbsRel ↓", "AbsRel_s ↓", "s")


def told_apart(results: Sequence[Result]) -> list[Result]:
    """Return the results, those of one method's name with the first digits of their archive's digest behind it."""
    names = Counter(result.method for result in results)
    return [
        replace(result, method=f"{result.method} ({result.submission_sha256[:8]})")
        if names[result.method] > 1
        else result
        for result in results
    ]


def print_paper_table(results: Sequence[Result], console: Console, *, published: bool) -> None:
    """Print a table per config: a row per result, then the paper's rows of that scene, marked, in no contest.

    ``results`` are of one dataset, at least one. Best first by native AbsRel; rows that are not ranked come last.
    """
    first = results[0]
    digest = wording.short_digest(first.dataset_digest)
    version = wording.printable(first.dataset_version)
    console.print(
        Text(f"protocol {PROTOCOL}, dataset {version} ({digest}), software {software_version()}", style="dim")
    )
    for config in dict.fromkeys(name for result in results for name in result.tables):
        rows = [(result.method, result.tables[config]) for result in results if config in result.tables]
        scene = paper_scene(config) if published else None
        views = rows[0][1].views
        console.print()
        console.print(
            Text(f"{wording.printable(config)}, {views} {wording.plural('view', views)}", style="italic")
        )
        console.print(_table(sorted(rows, key=lambda row: _place(row[1])), scene))
    console.print()
    console.print(Text("RMSE, AbsRel: native (no alignment). AbsRel_s: scaled (oracle median scale per view)."))
    console.print(Text("s: median over views of median(z)/median(p). ‡: not ranked."))
    if published:
        mark = load_published().parts["synthetic"].mark
        console.print(Text(f"The paper's rows: {mark}. †: median-anchored."))


def _table(rows: Sequence[tuple[str, Table]], scene: str | None) -> RichTable:
    grid = RichTable(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    grid.add_column("", overflow="fold")  # names give way, numbers never
    for head in _HEADS:
        grid.add_column(head, justify="right", no_wrap=True)
    for method, table in rows:
        grid.add_row(
            Text(wording.printable(method, 40) + ("" if table.ranked else " ‡")), *map(Text, _cells(table))
        )
    if scene is not None:
        grid.add_section()
        for row in published_rows(scene):
            mark = " †" if row.median_anchored else ""
            cells = (row.rmse_cm, row.abs_rel, row.abs_rel_scaled, row.scale)
            grid.add_row(Text(f"paper: {row.method}{mark}"), *map(Text, cells), style="dim")
    return grid


def _cells(table: Table) -> list[str]:
    native, scaled = wording.metric_cells(table.native), wording.metric_cells(table.scaled)
    return [native[1], native[0], scaled[0], wording.scale_cell(table.scale_median)]


def _place(table: Table) -> tuple[bool, float]:
    return not table.ranked, float("inf") if table.native is None else table.native.abs_rel
