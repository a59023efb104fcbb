"""Extended measures section of the report: charts, inspection measures, tolerances and collapsed families."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

from markupsafe import Markup

from rebar_depth_bench.errors import printable
from rebar_depth_bench.extended.crossings.measures import MISS_DEG
from rebar_depth_bench.extended.evaluate import MEASURE_FAMILIES, MeasureFamily
from rebar_depth_bench.extended.inspection.measures import INSPECTION_MEASURES, MISS_MM, capability_name
from rebar_depth_bench.extended.inspection.tolerances import (
    PROFILES,
    TOLERANCES,
    Tolerance,
    ToleranceProfile,
    pass_sample,
)
from rebar_depth_bench.extended.measures import EXTENDED_PROTOCOL, Measure
from rebar_depth_bench.extended.point_cloud import TOLERANCES_MM
from rebar_depth_bench.extended.predictions import NATIVE, ONCE, SCALED
from rebar_depth_bench.extended.profiles import AXES, bin_names
from rebar_depth_bench.extended.result import ExtendedResult, ExtendedTable, MeasureEstimate
from rebar_depth_bench.reporting.charts import ProfileBin, profile_chart
from rebar_depth_bench.reporting.extended_tables import MISSED, UNDEFINED, is_miss, single_bar_sentence
from rebar_depth_bench.scoring.columns import ARROWS, DASH, Cell

_TITLE_NUMBER = re.compile(r"\d[\d.]*(?:-[\d.]+)?(?= (?:mm|%|m|px|degrees)(?!\w))")
"""Tolerance, threshold or bin in a measure's title: a number followed by a unit."""


@dataclass(frozen=True)
class MeasureRow:
    """Table row of one measure: a cell per alignment, and the numbers of samples."""

    name: str
    unit: str
    better: str
    cells: list[Cell]
    samples: str


@dataclass(frozen=True)
class MeasureDefinition:
    """Definition of a measure, or of measures that differ only in a tolerance or bin."""

    name: str
    definition: str


def measure_rows(table: ExtendedTable, measures: Iterable[Measure], alignments: Sequence[str]) -> list[MeasureRow]:
    """Return a row for each measure that has samples under any of the ``alignments``, in order."""
    rows = []
    for measure in measures:
        estimates = [table.numbers[alignment][measure.name] for alignment in alignments]
        if any(estimate.samples for estimate in estimates):
            cells = [estimate_cell(estimate, measure) for estimate in estimates]
            samples = " / ".join(dict.fromkeys(str(estimate.samples) for estimate in estimates))
            rows.append(MeasureRow(measure.title, measure.unit, ARROWS[measure.better], cells, samples))
    return rows


def estimate_cell(estimate: MeasureEstimate, measure: Measure) -> Cell:
    """Return the cell of an estimate with its interval, formatted in the measure's unit."""
    if estimate.value is None:
        return Cell(UNDEFINED if estimate.samples else DASH, None)
    if not math.isfinite(estimate.value):
        return Cell("∞" if measure.convert is not None else DASH, None)
    if is_miss(estimate, measure):
        informative = estimate.interval is not None and estimate.interval[0] < estimate.interval[1]
        return Cell(MISSED, estimate.value, _interval_text(estimate.interval, measure) if informative else "")
    text = measure.column.text(estimate.value).replace("-", "−")
    return Cell(text, estimate.value, _interval_text(estimate.interval, measure))


def measure_definitions(measures: Iterable[Measure]) -> list[MeasureDefinition]:
    """Return the definitions of the measures.

    Measures whose titles differ only in a tolerance or bin share one definition, in which N stands for that
    number.
    """
    by_title: dict[str, list[Measure]] = {}
    for measure in measures:
        by_title.setdefault(_TITLE_NUMBER.sub("N", measure.title, count=1), []).append(measure)
    return [_measure_definition(title, group) for title, group in by_title.items()]


def _measure_definition(title: str, measures: Sequence[Measure]) -> MeasureDefinition:
    first = measures[0]
    if len(measures) == 1:
        return MeasureDefinition(first.title, first.definition)
    steps = [step[0] for measure in measures if (step := _TITLE_NUMBER.search(measure.title))]
    definition = _TITLE_NUMBER.sub(lambda step: "N" if step[0] == steps[0] else step[0], first.definition)
    return MeasureDefinition(title, f"{definition}; N: {', '.join(steps)}")


def _interval_text(ends: tuple[float, float] | None, measure: Measure) -> str:
    text = measure.column.interval_text(ends).replace("-", "−")
    return text.replace(" – ", " to ") if ends is not None and ends[0] < 0 else text


_ALIGNMENT_NOTES: Mapping[str, str] = {NATIVE: "no alignment", SCALED: "oracle median scale per view"}
_ONCE_NOTES: Mapping[str, str] = {
    "alignment": "own alignment, see the row",
    "boundary": "independent of scale",
}
_AXIS_TITLES: Mapping[str, tuple[str, str]] = {
    "m": ("distance", "m"),
    "px": ("bar width in the picture", "pixels"),
}
_FOLDED_FAMILIES = ("as_built", "alignment", "full_mask", "single_bar", "boundary", "layers", "clouds")

MAIN_INSPECTION_MEASURES = (
    "bars_found",
    "axis_offset_median_mm",
    "axis_offset_p95_mm",
    *(f"{kind}_{size}_mm" for kind in ("spacing", "layer", "diameter", "cover") for size in ("bias", "p95")),
)
"""Inspection measures that are shown openly; the others are collapsed."""

_CLOUD_KINDS = ("accuracy", "completeness", "f")


@dataclass(frozen=True)
class AlignmentHead:
    """Column heading: an alignment and a note that explains it."""

    alignment: str
    aside: str


@dataclass(frozen=True)
class ExtendedMeasureTable:
    """Table of the measures of one family.

    ``kind`` is "grid" for a table of tolerances (rows) by three shares (columns), else "rows". ``note`` explains a
    placeholder in the cells; it is empty if there is none.
    """

    title: str
    kind: str
    heads: list[AlignmentHead]
    rows: list[MeasureRow]
    measure_definitions: list[MeasureDefinition]
    note: str = ""


@dataclass(frozen=True)
class ToleranceRow:
    """Table row of one tolerance of a standard: pass rates, then capabilities, each native and scaled."""

    standard: str
    name: str
    limit_mm: Cell
    cells: list[Cell]


@dataclass(frozen=True)
class ExtendedConfig:
    """Formatted extended measures of one config.

    ``charts`` are pairs of caption and SVG. ``single_bar`` is a sentence on the single-bar interior, empty without
    scored pixels.
    """

    name: str
    views: int
    charts: list[tuple[str, Markup]]
    main_inspection: ExtendedMeasureTable
    other_inspection: ExtendedMeasureTable
    tolerances: list[ToleranceRow]
    families: list[ExtendedMeasureTable]
    single_bar: str = ""

    def has_undefined_capability(self) -> bool:
        """Return whether any capability is undefined, because too many bars were not found."""
        return any(cell.text == UNDEFINED for row in self.tolerances for cell in row.cells)


@dataclass(frozen=True)
class ExtendedSection:
    """Context of the section: its protocol, all configs, and the profiles that define the tolerances."""

    protocol: str
    configs: list[ExtendedConfig]
    profiles: tuple[ToleranceProfile, ...]


def extended_section(extended: ExtendedResult) -> ExtendedSection:
    """Return the context of ``part_extended.html.j2``."""
    configs = [_extended_config(name, table) for name, table in extended.tables.items()]
    return ExtendedSection(EXTENDED_PROTOCOL, configs, PROFILES)


def _extended_config(name: str, table: ExtendedTable) -> ExtendedConfig:
    inspection = MEASURE_FAMILIES["inspection"]
    shown = {*MAIN_INSPECTION_MEASURES, *(pass_sample(tolerance) for _, tolerance in TOLERANCES)}
    other = [measure for measure in INSPECTION_MEASURES if measure.name not in shown]
    profile = MEASURE_FAMILIES["profile"]
    folded = [
        *(_folded_table(table, key) for key in _FOLDED_FAMILIES),
        measure_table(table, f"{profile.title}: values", profile, profile.measures),
    ]
    charts = [(_AXIS_TITLES[axis][0], _profile_chart(table, axis)) for axis in AXES]
    return ExtendedConfig(
        name=printable(name),
        views=table.views,
        charts=[(title, chart) for title, chart in charts if chart],
        main_inspection=measure_table(
            table, inspection.title, inspection, [inspection.by_name[name] for name in MAIN_INSPECTION_MEASURES]
        ),
        other_inspection=measure_table(table, "Inspection: spread, median, found bars only", inspection, other),
        tolerances=[_tolerance_row(table, *line) for line in TOLERANCES],
        families=[family for family in folded if family.rows],
        single_bar=single_bar_sentence(table),
    )


def _folded_table(table: ExtendedTable, key: str) -> ExtendedMeasureTable:
    family = MEASURE_FAMILIES[key]
    if key == "clouds":
        return _cloud_table(table, family)
    return measure_table(table, family.title, family, family.measures, _ONCE_NOTES.get(key, ""))


def measure_table(
    table: ExtendedTable, title: str, family: MeasureFamily, measures: Sequence[Measure], once_aside: str = ""
) -> ExtendedMeasureTable:
    """Return the table of some measures of a family, those without samples left out."""
    rows = measure_rows(table, measures, family.alignments)
    units = {row.unit for row in rows if any(cell.text == MISSED for cell in row.cells)}
    values = " or ".join(f"{MISS_MM:g} mm" if unit else f"{MISS_DEG:g} degrees" for unit in sorted(units)[::-1])
    note = f"{MISSED}: not found, counted as {values}." if units else ""
    heads = _alignment_heads(family, once_aside)
    return ExtendedMeasureTable(title, "rows", heads, rows, measure_definitions(measures), note)


def _alignment_heads(family: MeasureFamily, once_aside: str = "") -> list[AlignmentHead]:
    notes = {**_ALIGNMENT_NOTES, ONCE: once_aside}
    return [AlignmentHead(alignment, notes[alignment]) for alignment in family.alignments]


def _cloud_table(table: ExtendedTable, family: MeasureFamily) -> ExtendedMeasureTable:
    """Return one row per tolerance with accuracy, completeness and F-score, first native, then scaled."""
    rows = []
    for tolerance_mm in TOLERANCES_MM:
        names = [f"cloud_{kind}_{tolerance_mm}mm" for kind in _CLOUD_KINDS]
        estimates_and_measures = [
            (table.numbers[alignment][name], family.by_name[name])
            for alignment in family.alignments
            for name in names
        ]
        if any(estimate.samples for estimate, _ in estimates_and_measures):
            cells = [estimate_cell(estimate, measure) for estimate, measure in estimates_and_measures]
            rows.append(MeasureRow(f"{tolerance_mm}", "mm", "", cells, str(estimates_and_measures[0][0].samples)))
    definitions = measure_definitions(family.measures)
    return ExtendedMeasureTable(family.title, "grid", _alignment_heads(family), rows, definitions)


def _tolerance_row(table: ExtendedTable, profile: ToleranceProfile, tolerance: Tolerance) -> ToleranceRow:
    measures = MEASURE_FAMILIES["inspection"].by_name
    cells = [
        estimate_cell(table.numbers[alignment][name], measures[name])
        for name in (pass_sample(tolerance), capability_name(tolerance))
        for alignment in (NATIVE, SCALED)
    ]
    limit_mm = Cell(f"{tolerance.limit_mm:g}", tolerance.limit_mm)
    return ToleranceRow(profile.title, tolerance.title, limit_mm, cells)


def _profile_chart(table: ExtendedTable, axis: str) -> Markup:
    native, scaled = table.numbers[NATIVE], table.numbers[SCALED]
    edges = AXES[axis]
    bins = [
        ProfileBin(
            low, high, native[f"abs_rel_at_{name}"], scaled[f"abs_rel_at_{name}"], native[f"scale_at_{name}"]
        )
        for (low, high), name in zip(pairwise(edges), bin_names(axis, edges), strict=True)
    ]
    return profile_chart(*_AXIS_TITLES[axis], bins)
