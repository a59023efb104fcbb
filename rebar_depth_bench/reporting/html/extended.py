"""Extended measures of the report: inspection, collapsed families, and crossings of bars."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rebar_depth_bench.base.errors import printable
from rebar_depth_bench.extended.crossings import MISS_DEG
from rebar_depth_bench.extended.estimates import ExtendedResult, ExtendedTable, MeasureEstimate
from rebar_depth_bench.extended.families import MEASURE_FAMILIES
from rebar_depth_bench.extended.fits import MISS_MM
from rebar_depth_bench.extended.measures import (
    EXTENDED_PROTOCOL,
    NATIVE,
    ONCE,
    SCALED,
    Measure,
    MeasureFamily,
)
from rebar_depth_bench.reporting.extended_tables import FITS_NOTE, MISSED, is_miss, single_bar_sentence
from rebar_depth_bench.scoring.bootstrap import Interval
from rebar_depth_bench.scoring.columns import DASH, Cell, Column

_HEAD_NOTES: Mapping[str, str] = {NATIVE: "no alignment", SCALED: "oracle median scale per view"}
_SHOWN_FAMILIES = ("inspection", "crossings")
"""Families that are shown openly; the others are collapsed, the deviation from the design first."""


@dataclass(frozen=True)
class MeasureTable:
    """Table of the measures of one family: a row per measure with a cell per alignment.

    ``heads`` are (alignment, note) of the columns; ``rows`` have the measure's column, its cells and the numbers
    of samples; ``definitions`` are (title, definition). ``note`` explains a placeholder in the cells; it is empty
    if there is none.
    """

    title: str
    heads: Sequence[tuple[str, str]]
    rows: Sequence[tuple[Column, list[Cell], str]]
    definitions: Sequence[tuple[str, str]]
    note: str = ""


@dataclass(frozen=True)
class ExtendedConfig:
    """Formatted extended measures of one config.

    ``single_bar`` is a sentence on the single-bar interior, empty without scored pixels.
    """

    name: str
    views: int
    inspection: MeasureTable
    families: list[MeasureTable]
    single_bar: str = ""


def extended_context(extended: ExtendedResult) -> dict[str, object]:
    """Return the context of the templates of extended measures and crossings."""
    tables, source = extended.tables, extended.crossings
    crossings = [
        (printable(name), measure_table(table, MEASURE_FAMILIES["crossings"]))
        for name, table in tables.items()
        if source is not None and name in extended.frames
    ]
    return {
        "extended": [extended_config(name, table) for name, table in tables.items()],
        "extended_protocol": EXTENDED_PROTOCOL,
        "crossings": crossings,
        "crossings_source": f"{printable(source.file)}, SHA-256 {printable(source.sha256)}" if source else "",
        "fits_note": FITS_NOTE,
    }


def extended_config(name: str, table: ExtendedTable) -> ExtendedConfig:
    """Return the formatted extended measures of a config."""
    others = [family for key, family in MEASURE_FAMILIES.items() if key not in _SHOWN_FAMILIES]
    others.sort(key=lambda family: family.key != "as_built")
    folded = [measure_table(table, family) for family in others]
    return ExtendedConfig(
        name=printable(name),
        views=table.views,
        inspection=measure_table(table, MEASURE_FAMILIES["inspection"]),
        families=[family for family in folded if family.rows],
        single_bar=single_bar_sentence(table),
    )


def measure_table(table: ExtendedTable, family: MeasureFamily) -> MeasureTable:
    """Return the table of the measures of a family, those without samples left out."""
    rows = []
    for measure in family.measures:
        estimates = [table.numbers[alignment][measure.name] for alignment in family.alignments]
        if any(estimate.samples for estimate in estimates):
            cells = [estimate_cell(estimate, measure) for estimate in estimates]
            samples = " / ".join(dict.fromkeys(str(estimate.samples) for estimate in estimates))
            rows.append((measure.column, cells, samples))
    units = {column.unit for column, cells, _ in rows if any(cell.text == MISSED for cell in cells)}
    values = " or ".join(f"{MISS_MM:g} mm" if unit else f"{MISS_DEG:g} degrees" for unit in sorted(units)[::-1])
    note = f"{MISSED}: not found, counted as {values}." if units else ""
    heads = {**_HEAD_NOTES, ONCE: family.note}
    return MeasureTable(
        family.title,
        [(alignment, heads[alignment]) for alignment in family.alignments],
        rows,
        [(measure.title, measure.definition) for measure in family.measures],
        note,
    )


def estimate_cell(estimate: MeasureEstimate, measure: Measure) -> Cell:
    """Return the cell of an estimate with its interval, formatted in the measure's unit."""
    value, ends = estimate.value, estimate.interval
    if value is None or not math.isfinite(value):
        return Cell(DASH)
    column = measure.column
    if is_miss(estimate, measure):
        informative = ends is not None and ends[0] < ends[1]
        return Cell(MISSED, value, _interval_text(ends, column) if informative else "")
    return Cell(column.text(value).replace("-", "−"), value, _interval_text(ends, column))


def _interval_text(ends: Interval | None, column: Column) -> str:
    separator = " to " if ends is not None and ends[0] < 0 else " – "
    return column.interval_text(ends, separator).replace("-", "−")
