"""Comparison tables of several results.

A paired comparison of two submissions is printed in the terminal or written as CSV; any number of results is
printed side by side in the layout of the paper's Table I.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from rich import box
from rich.console import Console
from rich.table import Table as RichTable

from rebar_depth_bench import software_version
from rebar_depth_bench.errors import printable
from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.reporting.published import (
    OTHER_OPTICS_MARK,
    OTHER_OPTICS_NOTE,
    load_published,
    published_rows,
)
from rebar_depth_bench.reporting.tables import frame_csv, plain_text
from rebar_depth_bench.scoring.bootstrap import BLOCK_VIEWS, MIN_BLOCKS
from rebar_depth_bench.scoring.columns import DASH, PAPER_COLUMNS, RANK_ERROR, rounded, texts
from rebar_depth_bench.scoring.comparison import Comparison, Difference
from rebar_depth_bench.scoring.frames import differences_frame
from rebar_depth_bench.scoring.protocol import PROTOCOL
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.scoring.table import PublishedMatch, Table

COMPARISON_NOTE = (
    "B - A: mean over the views that both have. 95 % interval: bootstrap of blocks of neighbouring views "
    f"({BLOCK_VIEWS} steps of the protocol), of whole scenes in configs with splits; none with fewer than "
    f"{MIN_BLOCKS} blocks or, with splits, scenes. B is called better "
    "or worse if the interval excludes zero, which happens by chance in about one of twenty comparisons. "
    "Errors of valid predictions are not compared if either submission has a coverage below 95 %, a view "
    "without prediction or an overflow; the rank error counts every scored pixel."
)
"""Explanation of the numbers of a comparison."""


def print_comparison(comparison: Comparison, console: Console) -> None:
    """Print a table per config: both submissions, their paired difference, its interval and the verdict."""
    first, other = (printable(archive.method) for archive in comparison.provenance.archives)
    console.print(plain_text(f"B: {other}, against A: {first}", style="bold"))
    console.print(plain_text(_provenance(comparison), style="dim"))
    for config, rows in comparison.configs.items():
        console.print()
        console.print(plain_text(f"{printable(config)}, {views_note(rows)}", style="italic"))
        console.print(_comparison_table(rows))
    console.print()
    console.print(plain_text(COMPARISON_NOTE))


def comparison_csv(comparisons: list[Comparison]) -> str:
    r"""Return comparisons as tidy CSV: one row per pair, config and number, with provenance, ``\n`` line ends."""
    return frame_csv(differences_frame([comparison.to_dict() for comparison in comparisons]))


def _provenance(comparison: Comparison) -> str:
    content = comparison.to_dict()
    dataset = content["dataset"]
    archives = (
        f"{letter} {formatting.short_digest(submission['sha256'])}"
        for letter, submission in zip("AB", content["submissions"], strict=True)
    )
    return (
        f"protocol {content['protocol']}, dataset {printable(dataset['version'])} "
        f"({formatting.short_digest(dataset['digest'])}), archives {', '.join(archives)}, "
        f"software {content['software']['version']}"
    )


def views_note(rows: Sequence[Difference]) -> str:
    """Return the number of views that the differences are computed on, as text."""
    counts = sorted({row.views for row in rows})
    if len(counts) == 1:
        return f"{counts[0]} views"
    return f"{counts[-1]} views; errors and scale on the {counts[0]} where both have a prediction"


def _comparison_table(rows: Sequence[Difference]) -> RichTable:
    table = RichTable(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    table.add_column("number", no_wrap=True)
    for heading in ("A", "B", "B - A", "95 % interval"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("B is")
    for row in rows:
        table.add_row(*map(plain_text, comparison_cells(row)))
    return table


def comparison_cells(row: Difference) -> list[str]:
    """Return title, both values, difference, interval and verdict as text."""
    column = row.column
    first, other = (column.number_text(value) for value in (row.first, row.other))
    interval = DASH if row.interval is None else " to ".join(map(column.signed_text, row.interval))
    return [column.heading, first, other, column.signed_text(row.difference), interval, row.verdict]


_HEADS = ("rank err. ↓", "RMSE cm ↓", "AbsRel ↓", "AbsRel_s ↓", "s")


def disambiguate_method_names(results: Sequence[Result]) -> list[Result]:
    """Return the results with unique method names.

    A name that occurs more than once gets the first eight digits of its submission's SHA-256 appended.
    """
    names = Counter(result.method for result in results)
    return [
        replace(
            result,
            submission=replace(result.submission, method=f"{result.method} ({result.submission.sha256[:8]})"),
        )
        if names[result.method] > 1
        else result
        for result in results
    ]


def print_paper_table(results: Sequence[Result], console: Console, *, published: bool) -> None:
    """Print a table per config: one row per result, sorted by rank error, then the rows that are not ranked.

    The reference errors of the config follow.

    ``results`` must not be empty and must belong to one dataset. With ``published``, the paper's rows of the same
    scene follow; they are marked and not compared with the results.
    """
    first = results[0]
    digest = formatting.short_digest(first.dataset.digest)
    version = printable(first.dataset.version)
    console.print(
        plain_text(
            f"protocol {PROTOCOL}, dataset {version} ({digest}), software {software_version()}", style="dim"
        )
    )
    for config in dict.fromkeys(name for result in results for name in result.tables):
        rows = [(result, result.tables[config]) for result in results if config in result.tables]
        match = rows[0][1].published if published else None
        table = rows[0][1]
        title = formatting.config_title(config, table.split)
        console.print()
        console.print(plain_text(f"{title}, {formatting.counted(table.views, 'view')}", style="italic"))
        console.print(_paper_table(sorted(rows, key=lambda row: _paper_table_sort_key(row[1])), match))
    console.print()
    console.print(
        plain_text("RMSE, AbsRel: native (no alignment). AbsRel_s: scaled (oracle median scale per view).")
    )
    console.print(
        plain_text(
            "s: median over views of median(z)/median(p). ‡: not ranked (declares the use of ground truth). "
            "?: use of ground truth not declared."
        )
    )
    console.print(plain_text(f"{formatting.RANK_ERROR_NOTE} {formatting.REFERENCE_NOTE}"))
    if published and any(table.published for result in results for table in result.tables.values()):
        mark = load_published().parts["synthetic"].mark
        console.print(plain_text(f"The paper's rows: {mark}. †: median-anchored. {OTHER_OPTICS_NOTE}"))


def _paper_table(rows: Sequence[tuple[Result, Table]], match: PublishedMatch | None) -> RichTable:
    grid = RichTable(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    grid.add_column("", overflow="fold")  # Long names are wrapped; numbers are never truncated.
    for head in _HEADS:
        grid.add_column(head, justify="right", no_wrap=True)
    for result, table in rows:
        grid.add_row(
            plain_text(printable(result.method, 40) + formatting.rank_mark(result.declared, table)),
            *map(plain_text, texts((RANK_ERROR, *PAPER_COLUMNS), table)),
        )
    for title, cells in formatting.paper_reference_rows([(result.method, table) for result, table in rows]):
        grid.add_row(plain_text(f"reference: {title}"), "", *map(plain_text, cells), style="dim")
    if match is not None:
        grid.add_section()
        for row in published_rows(match.scene):
            mark = (" †" if row.median_anchored else "") + ("" if match.same_optics else f" {OTHER_OPTICS_MARK}")
            grid.add_row(plain_text(f"paper: {row.method}{mark}"), "", *map(plain_text, row.cells), style="dim")
    return grid


def _paper_table_sort_key(table: Table) -> tuple[bool, float]:
    return not table.ranked, rounded(table.rank_error) or 0.0
