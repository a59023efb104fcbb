"""Extended measures as terminal tables, one per config, and as tidy CSV."""

from __future__ import annotations

import math
from functools import partial

from rich.console import Console
from rich.padding import Padding

from rebar_depth_bench.base.errors import printable
from rebar_depth_bench.extended.crossings import MISS_DEG
from rebar_depth_bench.extended.estimates import ExtendedResult, ExtendedTable, MeasureEstimate
from rebar_depth_bench.extended.families import MEASURE_FAMILIES
from rebar_depth_bench.extended.fits import MISS_MM
from rebar_depth_bench.extended.measures import EXTENDED_PROTOCOL, NATIVE, SCALED, Measure, MeasureFamily
from rebar_depth_bench.reporting.tables import make_grid, plain_text, print_line
from rebar_depth_bench.scoring.columns import DASH, number, range_text
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.scoring.spreadsheet import Sheet

FITS_NOTE = (
    "The fits take from the ground truth which pixels show which bar and which the form, the radius of each bar, "
    "and each pixel's position along the bar. A method that has to find the bars itself can only be worse."
)

MISSED = "missed"
"""Text of an error of ``MISS_MM``, the value assigned to bars that were not found."""

_ZERO_TOLERANCE = 1e-12
"""Magnitude below which a value is a rounding error and is shown as 0."""

_FIRST_ROWS = 3
"""Number of measures of each family that are printed if no family is named."""

_MIN_WIDTH_WITH_INTERVALS = 100
"""Least console width that shows intervals, characters; in a narrower one, names would take three lines each."""


def print_extended(extended: ExtendedResult, console: Console, only: str = "") -> None:
    """Print the first measures of each family, or all of the family ``only``, native beside scaled.

    Measures without a value are left out. A wide console also shows the intervals.
    """
    wide = console.width >= _MIN_WIDTH_WITH_INTERVALS
    for config, table in extended.tables.items():
        console.print()
        print_line(console, f"{printable(config)}, {EXTENDED_PROTOCOL}, {table.views} views", style="bold")
        grid = make_grid("", ("native", "95 %", "scaled", "95 %") if wide else ("native", "scaled"), fold=True)
        for family in MEASURE_FAMILIES.values():
            rows = [(measure, measure_cells(table, family, measure)) for measure in family.measures]
            known_rows = [(measure, texts) for measure, texts in rows if not {*texts} <= {DASH, ""}]
            if not known_rows or only not in ("", family.key):
                continue
            grid.add_section()
            grid.add_row(plain_text(family.title, style="italic"))
            shown_rows = known_rows if only else known_rows[:_FIRST_ROWS]
            for measure, texts in shown_rows:
                heading = Padding(measure.column.heading, (0, 0, 0, 2))
                grid.add_row(heading, *map(plain_text, texts if wide else texts[::2]))
            if hidden := len(known_rows) - len(shown_rows):
                grid.add_row(plain_text(f"  and {hidden} more: --family {family.key}", style="dim"))
        console.print(grid)
    numbers = [(measure, estimate) for _, _, measure, estimate in extended.estimates()]
    if any(is_miss(estimate, measure) for measure, estimate in numbers):
        note = f"{MISSED}: not found, recorded as {MISS_MM:g} mm or {MISS_DEG:g} degrees in CSV and JSON."
        print_line(console, note)
    if not wide:
        width = _MIN_WIDTH_WITH_INTERVALS
        print_line(
            console, f"Intervals: in CSV, JSON and the report, and in terminals with at least {width} columns."
        )
    note = "Numbers without a scaled one are of native depth, or independent of scale."
    print_line(console, f"{note} Definitions: docs/measures.md.")


def measure_cells(table: ExtendedTable, family: MeasureFamily, measure: Measure) -> list[str]:
    """Return the four cells of a measure: value and interval, native and scaled.

    The last two are empty for a measure with one alignment.
    """
    texts: list[str] = []
    for alignment in family.alignments:
        estimate = table.numbers[alignment][measure.name]
        if is_miss(estimate, measure):
            texts += [MISSED, DASH]
        else:
            texts += [
                format_value(estimate.value, measure),
                range_text(estimate.interval, partial(format_value, measure=measure, digits=3)),
            ]
    return texts + [""] * (4 - len(texts))


def is_miss(estimate: MeasureEstimate, measure: Measure) -> bool:
    """Return whether an error has the value ``MISS_MM`` or ``MISS_DEG`` of what was not found."""
    misses = (("_judged_mm", MISS_MM), ("_judged_deg", MISS_DEG))
    return any(measure.sample.endswith(suffix) and estimate.value == miss for suffix, miss in misses)


def format_value(value: float | None, measure: Measure, digits: int = 4) -> str:
    """Return a measure's value in its unit: per cent with one decimal, else ``digits`` significant digits.

    An undefined value is a dash.
    """
    if value is None or not math.isfinite(value):
        return DASH
    if measure.column.as_text is not None:
        return measure.column.as_text(value)
    value = value if abs(value) >= _ZERO_TOLERANCE else 0.0
    return f"{100 * value:.1f}" if measure.unit == "%" else f"{value:.{digits}g}"


def single_bar_sentence(table: ExtendedTable) -> str:
    """Return share and AbsRel of the single-bar interior beside AbsRel of the whole one; empty without pixels."""
    share = table.numbers[NATIVE]["single_bar_share"].value
    if share is None:
        return ""
    text = f"{100 * share:.1f} % of the scored pixels, mean over views, belong to one bar with all neighbours"
    if not share:
        return f"{text}: every scored pixel has a second bar within one pixel."
    errors = [
        f"{alignment} {number(table.numbers[alignment]['single_bar_abs_rel'].value, 4)} "
        f"(all scored pixels: {number(table.numbers[alignment]['single_bar_views_abs_rel'].value, 4)})"
        for alignment in (NATIVE, SCALED)
    ]
    return (
        f"{text}. AbsRel on them, mean over the views that have any: {', '.join(errors)}. On the others a "
        "second bar is within one pixel, so that a shift by one pixel already causes an error."
    )


def extended_csv(result: Result) -> str:
    r"""Return the extended tables as tidy CSV: one row per config, alignment and measure, ``\n`` line ends."""
    if result.extended is None:
        raise ValueError("the result has no extended measures")
    sheet = result.extended.to_sheet()
    provenance = {
        "protocol": EXTENDED_PROTOCOL,
        "dataset_digest": result.dataset.digest,
        "submission_sha256": result.submission.sha256,
        "software_version": result.software.version,
    }
    rows = [[result.method, *row, *provenance.values()] for row in sheet.rows]
    return Sheet(["method", *sheet.heads, *provenance], rows).to_csv()
