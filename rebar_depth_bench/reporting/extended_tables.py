"""Extended measures as text: a table per config in the terminal, and tidy CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Mapping

from rich import box
from rich.console import Console
from rich.padding import Padding
from rich.table import Table as RichTable
from rich.text import Text

from rebar_depth_bench.extended.evaluate import FAMILIES, Family
from rebar_depth_bench.extended.inspection.measures import MISS_MM
from rebar_depth_bench.extended.measures import EXTENDED_PROTOCOL, Measure
from rebar_depth_bench.extended.result import Estimate, ExtendedResult, ExtendedTable
from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.reporting.tables import csv_cell
from rebar_depth_bench.scoring.bootstrap import Interval
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.scoring.rounding import INTERVAL_DIGITS, rounded

NOT_TOLD = "not told"
"""Stands for a capability whose p95 is of what was not found."""

MISSED = "missed"
"""Stands for an error of ``MISS_MM``: that of what was not found."""

_ROUNDING = 1e-12
"""What is smaller came from rounding and is shown as 0."""

_INTERVALS_FROM = 100
"""Narrower consoles show no intervals: names would take three lines each."""

_ARROWS: Mapping[str, str] = {"lower": " ↓", "higher": " ↑", "": ""}


def print_extended(extended: ExtendedResult, console: Console) -> None:
    """Print every measure that has a value, native beside scaled, with its interval where the console is wide."""
    wide = console.width >= _INTERVALS_FROM
    for config, table in extended.tables.items():
        console.print()
        console.print(
            Text(f"{formatting.printable(config)}, {EXTENDED_PROTOCOL}, {table.views} views", style="bold")
        )
        grid = RichTable(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0), show_edge=False)
        grid.add_column("", overflow="fold")  # names give way, numbers never
        for heading in ("native", "95 %", "scaled", "95 %") if wide else ("native", "scaled"):
            grid.add_column(heading, justify="right", no_wrap=True)
        for family in FAMILIES.values():
            rows = [(measure, cells(table, family, measure)) for measure in family.measures]
            known = [(measure, shown) for measure, shown in rows if any(cell != formatting.DASH for cell in shown)]
            if known:
                grid.add_section()
                grid.add_row(Text(family.title, style="italic"))
            for measure, shown in known:
                grid.add_row(Padding(heading_of(measure), (0, 0, 0, 2)), *map(Text, shown if wide else shown[::2]))
        console.print(grid)
    numbers = [(measure, one) for _, _, measure, one in _numbers(extended)]
    if any(is_miss(one, measure) for measure, one in numbers):
        console.print(Text(f"{MISSED}: the error of what was not found, {MISS_MM:g} mm in CSV and JSON."))
    if any(one.value is None and one.samples for _, one in numbers):
        console.print(Text(f"{NOT_TOLD}: 5 % or more were not found."))
    if not wide:
        console.print(Text(f"Intervals: in CSV, JSON and the report, and here from {_INTERVALS_FROM} columns on."))
    note = "One number in the first column: no scale changes it, or it brings its own alignment."
    console.print(Text(f"{note} Definitions: cards/BENCHMARK.md."))


def heading_of(measure: Measure) -> str:
    """Return a measure's title with unit and better direction."""
    unit = f", {measure.unit}" if measure.unit else ""
    return f"{measure.title}{unit}{_ARROWS[measure.better]}"


def cells(table: ExtendedTable, family: Family, measure: Measure) -> list[str]:
    """Return value and interval of a measure, native and scaled; the last two are empty where it is taken once."""
    shown: list[str] = []
    for alignment in family.alignments:
        one = table.numbers[alignment][measure.name]
        if is_miss(one, measure):
            shown += [MISSED, formatting.DASH]
        else:
            told = one.value is not None or not one.samples
            shown += [spelled(one.value, measure) if told else NOT_TOLD, _between(one.interval, measure)]
    return shown + [""] * (4 - len(shown))


def is_miss(one: Estimate, measure: Measure) -> bool:
    """Return whether an error's value is the one that stands for what was not found."""
    return measure.sample.endswith("_judged_mm") and measure.convert is None and one.value == MISS_MM


def spelled(value: float | None, measure: Measure, digits: int = 4) -> str:
    """Return a measure's value in its unit: a share with one decimal, else significant digits, or a dash."""
    if value is None or not math.isfinite(value):
        return formatting.DASH
    value = value if abs(value) >= _ROUNDING else 0.0
    return f"{100 * value:.1f}" if measure.unit == "%" else f"{value:.{digits}g}"


def extended_csv(result: Result) -> str:
    r"""Return the extended tables as tidy CSV: a row per config, alignment and measure; ``\n`` ends."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    head = ["method", "config", "alignment", "measure", "unit", "statistic", "value", "low", "high", "samples"]
    stamps = ["protocol", "dataset_digest", "submission_sha256", "software_version"]
    writer.writerow(head + stamps)
    if result.extended is not None:
        stamp = [EXTENDED_PROTOCOL, result.dataset_digest, result.submission_sha256, result.software_version]
        for config, alignment, measure, one in _numbers(result.extended):
            low, high = one.interval or (None, None)
            named = [result.method, config, alignment, measure.name, measure.unit, measure.statistic]
            numbers = [
                rounded(one.value),
                rounded(low, INTERVAL_DIGITS),
                rounded(high, INTERVAL_DIGITS),
                one.samples,
            ]
            writer.writerow([csv_cell(cell) for cell in (*named, *numbers, *stamp)])
    return out.getvalue()


def _numbers(extended: ExtendedResult) -> Iterator[tuple[str, str, Measure, Estimate]]:
    for config, table in extended.tables.items():
        for alignment, measures in extended.measures.items():
            for measure in measures:
                yield config, alignment, measure, table.numbers[alignment][measure.name]


def _between(ends: Interval | None, measure: Measure) -> str:
    return formatting.DASH if ends is None else " to ".join(spelled(end, measure, 3) for end in ends)
