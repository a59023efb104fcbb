"""Tables in the terminal: of one result, of the comparison of two, and of several as in the paper's Table I."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from rich import box
from rich.console import Console
from rich.measure import Measurement
from rich.segment import Segments
from rich.table import Table as RichTable
from rich.text import Text

from rebar_depth_bench import software_version
from rebar_depth_bench.base.errors import printable
from rebar_depth_bench.base.terminal import terminal_text
from rebar_depth_bench.reporting.published import (
    OTHER_OPTICS_MARK,
    OTHER_OPTICS_NOTE,
    load_published,
    published_rows,
)
from rebar_depth_bench.scoring import formatting
from rebar_depth_bench.scoring.bootstrap import BLOCK_VIEWS, MIN_BLOCKS
from rebar_depth_bench.scoring.columns import (
    ALIGNED_METRICS,
    COVERAGE,
    DISTRIBUTION,
    METRIC_COLUMNS,
    NATIVE,
    ONE_PIXEL,
    PAPER_COLUMNS,
    RANK_ERROR,
    RELATIVE_ALIGNMENTS,
    SCALE,
    SCALED,
    SCALED_CONSTANT,
    TABLE_COLUMNS,
    WITHIN,
    Column,
    range_text,
    texts,
    with_reference,
)
from rebar_depth_bench.scoring.relative import ALIGNMENT_BY_KIND
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.scoring.table import PublishedMatch, Table
from rebar_depth_bench.submission.declaration import METRIC

if TYPE_CHECKING:
    from rebar_depth_bench.scoring.comparison import Comparison, Difference

_UNBOUNDED = 10_000


def plain_text(text: str, style: str = "") -> Text:
    """Return text for the terminal, without markup; control characters of names in it are shown as escapes."""
    return Text(terminal_text(text), style=style)


def print_line(console: Console, line: str, style: str = "") -> None:
    """Print plain text, wrapped at words, without markup or highlighting of numbers."""
    console.print(plain_text(line, style))


def make_grid(name: str | Text, heads: Sequence[str | Text], *, fold: bool = False) -> RichTable:
    """Return a table without rows: names, wrapped if ``fold``, and right-aligned columns, never truncated."""
    grid = RichTable(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0), show_edge=False)
    grid.add_column(name, no_wrap=not fold, overflow="fold" if fold else "ellipsis")
    for head in heads:
        grid.add_column(head, justify="right", no_wrap=True)
    return grid


def print_unwrapped(console: Console, table: RichTable) -> None:
    """Print a table at its natural width even if the console is narrower, because rich would truncate numbers."""
    width = _width(table, console)
    options = console.options.update(width=width, max_width=width)
    console.print(Segments(list(console.render(table, options))), soft_wrap=True, end="")


def _width(table: RichTable, console: Console) -> int:
    """Return the width at which nothing in ``table`` is wrapped or truncated, characters."""
    return Measurement.get(console, console.options.update(max_width=_UNBOUNDED), table).maximum


# Table of one result.

Columns = Sequence[Column]
Row = tuple[str, Mapping[str, str], str]
"""Row of a table: name, texts by place of the column that they are shown in, and style. A heading has no texts."""

_VIEWS_SCORED = Column("scored_of_views", "views", head="views\nscored\n/all")
"""Column of the numbers of scored and of all views."""
_BASE = (_VIEWS_SCORED, COVERAGE, RANK_ERROR)
_ALL_SCALED = (*SCALED, SCALE)
_LAYOUTS: Sequence[Sequence[Columns]] = (
    [[*_BASE, *NATIVE, *_ALL_SCALED, *DISTRIBUTION]],
    [[*NATIVE, *_ALL_SCALED], [*_BASE, *DISTRIBUTION]],
    [[*_BASE, *NATIVE], _ALL_SCALED, DISTRIBUTION],
)
"""Columns of each table to print, from the widest to the narrowest layout."""
_TITLES = (
    (NATIVE[0], "native (no alignment)"),
    (SCALED[0], "scaled (oracle median scale per view, s = median(z)/median(p))"),
    (WITHIN[0], "within t mm (native): share of all scored pixels with |p - z| <= t"),
)
"""First column of each group of columns, and a title that states their alignment."""

_GROUP_NATIVE = (*_BASE, *with_reference(NATIVE), *ONE_PIXEL)
_GROUP_SCALED = (*with_reference(SCALED), *SCALED_CONSTANT, SCALE)
_GROUP_LAYOUTS: Sequence[Sequence[Columns]] = ([[*_GROUP_NATIVE, *_GROUP_SCALED]], [_GROUP_NATIVE, _GROUP_SCALED])
"""Columns of the tables of groups of views."""

_ALIGNED_BASE = (_VIEWS_SCORED, COVERAGE, *ALIGNED_METRICS[:5])
_ALIGNED_LAYOUTS: Sequence[Sequence[Columns]] = (
    [[*_ALIGNED_BASE, *ALIGNED_METRICS[5:]]],
    [_ALIGNED_BASE, ALIGNED_METRICS[5:]],
)
"""Columns of the tables of predictions that are not metric."""


def print_table(result: Result, console: Console) -> None:
    """Print one row per config, followed by its reference errors: in one table if it fits, else in two or three.

    The groups of views of a config with splits follow, one row per group. Numbers are never truncated: a console
    narrower than the narrowest layout gets longer lines.
    """
    shown = formatting.summary(result)
    print_line(console, shown.heads[0], style="bold")
    print_line(console, shown.provenance, style="dim")
    print_line(console, shown.declared, style="dim")
    layouts, group_layouts = _LAYOUTS, _GROUP_LAYOUTS
    if result.prediction is not None:
        layouts = group_layouts = _ALIGNED_LAYOUTS
    _print_rows(_config_rows(result.tables), console, layouts, "config")
    for config, table in result.tables.items():
        if table.groups:
            console.print()
            print_line(console, f"{formatting.config_title(config, table.split)}: groups of views", style="bold")
            _print_rows(_group_rows(table), console, group_layouts, "group")
    # Possible mistakes, which the notes of a result also have, go to standard error.
    _print_notes(result, formatting.result_notes(result), console)


def _config_rows(tables: Mapping[str, Table]) -> list[Row]:
    rows: list[Row] = []
    for name, table in tables.items():
        rows += _table_rows(formatting.config_title(name, table.split), table)
        rows += [(f"  {title}", shown, "dim") for title, shown in formatting.reference_rows([("", table)])]
        judged = SCALED[0] if table.kind == METRIC else ALIGNED_METRICS[0]
        rows.append(("  margin", {judged.place: formatting.margin_text(table)}, "dim"))
    return rows


def _table_rows(title: str, table: Table) -> list[Row]:
    """Return the row of a table, or three rows of predictions that are not metric: both alignments, the constant.

    A rank error that does not rank is marked.
    """
    shown = {_VIEWS_SCORED.place: table.scored_of_views, COVERAGE.place: COVERAGE.text(table[COVERAGE.place])}
    if table.kind == METRIC:
        columns = (*METRIC_COLUMNS, *ONE_PIXEL, *SCALED_CONSTANT)
        shown |= {column.place: column.text(table[column.place]) for column in columns}
        if not table.ranked:
            shown[RANK_ERROR.place] += "‡"
        return [(title, shown, "")]
    rows: list[Row] = []
    below = " " * (len(title) - len(title.lstrip()) + 2)
    for name, alignment in zip((title, f"{below}robust", f"{below}constant"), RELATIVE_ALIGNMENTS, strict=True):
        if not math.isnan(table[f"{alignment}.error"]):
            shown |= {one.place: one.text(table[f"{alignment}.{one.place}"]) for one in ALIGNED_METRICS}
            rows.append((name, shown, "dim" if rows else ""))
            shown = {}
    return rows


def _group_rows(table: Table) -> list[Row]:
    """Return the rows of the groups of views of a config, with a heading for each grouping."""
    rows: list[Row] = []
    for grouping, groups in table.groups.items():
        rows.append((formatting.grouping_title(grouping), {}, "italic"))
        for group, of_group in groups.items():
            rows += _table_rows(f"  {printable(group)}", of_group)
    return rows


def _print_rows(rows: Sequence[Row], console: Console, layouts: Sequence[Sequence[Columns]], head: str) -> None:
    """Print rows in the layout with as few tables as the console's width allows."""
    for layout in layouts:
        tables = [_rich_table(rows, columns, head) for columns in layout]
        if all(_width(table, console) <= console.width for table in tables):
            break
    for columns, table in zip(layout, tables, strict=True):
        console.print()
        for first, title in _TITLES if layouts is _LAYOUTS else ():
            if first in columns:
                print_line(console, title, style="italic")
        print_unwrapped(console, table)


def _rich_table(rows: Sequence[Row], columns: Columns, head: str) -> RichTable:
    """Return the table of headings, and of the rows that have a text in any of the columns."""
    heads = [head, *(column.head or column.heading.replace(", ", "\n", 1) for column in columns)]
    lines = max(one.count("\n") for one in heads)
    heads = ["\n" * (lines - one.count("\n")) + one for one in heads]
    table = make_grid(heads[0], heads[1:])
    for name, shown, style in rows:
        cells = [shown.get(column.place, "") for column in columns]
        if not shown:
            table.add_section()
        if any(cells) or not shown:
            table.add_row(*map(plain_text, [name, *cells]), style=style)
    return table


def _print_notes(result: Result, notes: Sequence[str], console: Console) -> None:
    console.print()
    if result.prediction is not None:
        print_line(console, f"Means over views. ↓ lower, ↑ higher is better. {formatting.ALIGNED_NOTE}")
    else:
        means = "Means over views; s: median over views. z: truth, p: prediction. ↓ lower, ↑ higher is better."
        print_line(console, means)
        print_line(console, f"{formatting.RANK_ERROR_NOTE} {formatting.REFERENCE_NOTE} ‡: not ranked.")
    print_line(console, "Margin: share by which an error is below that of the constant; negative if it is above.")
    for note in notes:
        print_line(console, note, style="yellow")
    if any(table.groups for table in result.tables.values()):
        note = formatting.GROUP_NOTE if result.prediction is None else formatting.ALIGNED_GROUP_NOTE
        print_line(console, f"{note} Intervals: in JSON and the report.")
    if formatting.has_dash(result):
        print_line(console, formatting.DASH_NOTE)


# Table of a paired comparison of two submissions.

COMPARISON_NOTE = (
    "B - A: mean over the views that both have. 95 % interval: bootstrap of blocks of neighbouring views "
    f"({BLOCK_VIEWS} steps of the trajectory), of views within each distance of a survey, of whole scenes in "
    f"configs with splits; none with fewer than {MIN_BLOCKS} blocks or, with splits, scenes, and a survey needs "
    "one view more for each further distance. B is called better or worse if the interval excludes zero, which "
    "happens by chance in about one of twenty comparisons. "
    "Errors of valid predictions are not compared if either submission has a coverage below 95 %, a view "
    "without prediction or an overflow; the error over all scored pixels always is."
)
"""Explanation of the numbers of a comparison."""


def print_comparison(comparison: Comparison, console: Console) -> None:
    """Print a table per config: both submissions, their paired difference, its interval and the verdict."""
    first, other = (printable(archive.method) for archive in comparison.provenance.archives)
    print_line(console, f"B: {other}, against A: {first}", style="bold")
    content = comparison.to_dict()
    dataset = content["dataset"]
    archives = (
        f"{letter}: {formatting.archive_text(submission['sha256'])}"
        for letter, submission in zip("AB", content["submissions"], strict=True)
    )
    print_line(
        console,
        f"protocol {content['protocol']}, dataset {printable(dataset['version'])} "
        f"({formatting.short_digest(dataset['digest'])}), {', '.join(archives)}, "
        f"software {content['software']['version']}",
        style="dim",
    )
    for config, rows in comparison.configs.items():
        console.print()
        print_line(console, f"{printable(config)}, {views_note(rows)}", style="italic")
        table = make_grid("number", ("A", "B", "B - A", "95 % interval"))
        table.add_column("B is")
        for row in rows:
            table.add_row(*map(plain_text, comparison_cells(row)))
        print_unwrapped(console, table)
    console.print()
    print_line(console, COMPARISON_NOTE)


def views_note(rows: Sequence[Difference]) -> str:
    """Return the number of views that the differences are computed on, as text."""
    counts = sorted({row.views for row in rows})
    if len(counts) == 1:
        return f"{counts[0]} views"
    return f"{counts[-1]} views; errors and scale on the {counts[0]} where both have a prediction"


def comparison_cells(row: Difference) -> list[str]:
    """Return title, both values, difference, interval and verdict as text."""
    column = row.column
    first, other = (column.text(value) for value in (row.first, row.other))
    interval = range_text(row.interval, column.signed_text)
    return [column.heading, first, other, column.signed_text(row.difference), interval, row.verdict]


# Table of several results in the layout of the paper's Table I.

_HEADS = ("rank\nerr. ↓", "cov.\n% ↑", "5 mm\n% ↑", "RMSE\ncm ↓", "AbsRel\n↓", "AbsRel_s\n↓", "\ns")


_NONE = [""] * len(TABLE_COLUMNS)
"""Cells of rows that have the numbers of the paper's table only."""


def disambiguate_method_names(results: Sequence[Result]) -> list[Result]:
    """Return the results with unique method names.

    A name that occurs more than once gets the first eight digits of its submission's SHA-256 appended, if there is
    an archive, and the next number from 2 on that makes it unique if another result has that name.
    """
    names = Counter(result.method for result in results)
    used = {name for name, count in names.items() if count == 1}
    renamed = []
    for result in results:
        submission = result.submission
        if names[result.method] > 1:
            digest = f" ({submission.sha256[:8]})" if submission.sha256 else ""
            method, number = f"{result.method}{digest}", 1
            while method in used:
                number += 1
                method = f"{result.method}{digest} {number}"
            used.add(method)
            submission = replace(submission, method=method)
        renamed.append(replace(result, submission=submission))
    return renamed


def print_paper_table(
    results: Sequence[Result], console: Console, *, published: bool, absent: Sequence[str] = ()
) -> None:
    """Print a table per config: one row per result, sorted by rank error, then the rows that are not ranked.

    The reference errors of the config follow.

    ``results`` must not be empty and must belong to one dataset. With ``published``, the paper's rows of the same
    scene follow; they are marked and not compared with the results. If none do, ``absent`` are configs and why.
    Results that are not metric follow in one block per kind, sorted by aligned error.
    """
    dataset = results[0].dataset
    digest, version = formatting.short_digest(dataset.digest), printable(dataset.version)
    for number, block in enumerate(formatting.kind_blocks(results)):
        kind, protocol = block[0].prediction, block[0].protocol
        if number:
            console.print()
        line = f"protocol {protocol}, dataset {version} ({digest}), software {software_version()}"
        print_line(console, line, style="dim")
        if kind is not None:
            print_line(console, f"{kind}: {ALIGNMENT_BY_KIND[kind]}", style="italic")
        for config in dict.fromkeys(name for result in block for name in result.tables):
            rows = [(result, result.tables[config]) for result in block if config in result.tables]
            table = rows[0][1]
            title = formatting.config_title(config, table.split)
            console.print()
            print_line(console, f"{title}, {formatting.counted(table.views, 'view')}", style="italic")
            rows.sort(key=lambda row: (not row[1].ranked, formatting.sort_error(row[1])))
            if kind is None:
                console.print(_paper_table(rows, table.published if published else None))
                if similar := [printable(result.method) for result, of in rows if formatting.is_like_constant(of)]:
                    limit = f"AbsRel_s is not below {100 * (1 - formatting.LEAST_MARGIN):.0f} % of a constant's"
                    print_line(console, f"{limit}: {', '.join(similar)}.", style="yellow")
            else:
                aligned = [row for result, of in rows for row in _table_rows(formatting.row_name(result, of), of)]
                _print_rows(aligned, console, _ALIGNED_LAYOUTS, "")
                for result, of in rows:
                    for note in formatting.constant_findings(of):
                        print_line(console, f"{printable(result.method)}: {note}", style="yellow")
        console.print()
        _print_paper_notes(block, console, absent if kind is None else (), published=published)


def _print_paper_notes(
    results: Sequence[Result], console: Console, absent: Sequence[str], *, published: bool
) -> None:
    if results[0].prediction is None:
        native = "RMSE, AbsRel: native (no alignment). AbsRel_s: scaled (oracle median scale per view)."
        print_line(console, f"{native} s: median over views of median(z)/median(p).")
        print_line(
            console,
            "cov.: coverage. 5 mm: share of all scored pixels with a native error of at most 5 mm.",
        )
        print_line(console, f"{formatting.RANK_ERROR_NOTE} {formatting.RANK_PURPOSE_NOTE}")
        print_line(console, formatting.REFERENCE_NOTE)
    else:
        print_line(console, formatting.ALIGNED_NOTE)
    for note in formatting.row_notes(results, absent):
        print_line(console, formatting.note_text(*note), style="yellow")
    if published and any(table.published for result in results for table in result.tables.values()):
        mark = load_published().parts["synthetic"].mark
        print_line(console, f"The paper's rows: {mark}. †: median-anchored. {OTHER_OPTICS_NOTE}")


def _paper_table(rows: Sequence[tuple[Result, Table]], match: PublishedMatch | None) -> RichTable:
    paper = make_grid("", _HEADS, fold=True)
    for result, table in rows:
        cells = texts((*TABLE_COLUMNS, *PAPER_COLUMNS), table)
        paper.add_row(*map(plain_text, [formatting.row_name(result, table), *cells]))
    for title, cells in formatting.paper_reference_rows([(result.method, table) for result, table in rows]):
        paper.add_row(*map(plain_text, [f"reference: {title}", *_NONE, *cells]), style="dim")
    if match is not None:
        paper.add_section()
        for row in published_rows(match.scene):
            mark = (" †" if row.median_anchored else "") + ("" if match.same_optics else f" {OTHER_OPTICS_MARK}")
            paper.add_row(*map(plain_text, [f"paper: {row.method}{mark}", *_NONE, *row.cells]), style="dim")
    return paper
