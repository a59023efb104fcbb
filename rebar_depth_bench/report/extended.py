"""The extended measures' part of the page: charts, inspection, tolerances, and the other families folded away."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise

from markupsafe import Markup

from rebar_depth_bench import wording
from rebar_depth_bench.extended.capabilities import capability_name
from rebar_depth_bench.extended.clouds import TOLERANCES_MM
from rebar_depth_bench.extended.evaluation import FAMILIES, NATIVE, ONCE, SCALED, Family
from rebar_depth_bench.extended.inspection import MEASURES as INSPECTION_MEASURES
from rebar_depth_bench.extended.inspection_measures import MISS_MM
from rebar_depth_bench.extended.measures import EXTENDED_PROTOCOL, Measure
from rebar_depth_bench.extended.profile import AXES, bin_names
from rebar_depth_bench.extended.result import ExtendedResult, ExtendedTable
from rebar_depth_bench.extended.table import MISSED, NOT_TOLD
from rebar_depth_bench.extended.tolerances import PROFILES, Tolerance, ToleranceProfile, pass_sample
from rebar_depth_bench.report.extended_rows import (
    Meaning,
    MeasureRow,
    estimate_cell,
    meanings,
    measure_rows,
)
from rebar_depth_bench.report.profile_charts import ProfileBin, profile_chart
from rebar_depth_bench.report.rows import Cell

_ASIDES: Mapping[str, str] = {NATIVE: "no alignment", SCALED: "oracle median scale per view"}
_ONCE_ASIDES: Mapping[str, str] = {
    "alignment": "own alignment, named in the row",
    "boundary": "no scale changes it",
}
_AXIS_TITLES: Mapping[str, tuple[str, str]] = {
    "m": ("distance", "m"),
    "px": ("bar width in the picture", "pixels"),
}
_FOLDED = ("alignment", "full_mask", "boundary", "layers", "clouds")

FIRST = (
    "bars_found",
    "axis_offset_median_mm",
    "axis_offset_p95_mm",
    *(f"{kind}_{size}_mm" for kind in ("spacing", "layer", "diameter", "cover") for size in ("bias", "p95")),
)
"""What an inspector asks first."""

_CLOUD_KINDS = ("accuracy", "completeness", "f")


@dataclass(frozen=True)
class Head:
    """A column's alignment, and what that alignment is."""

    alignment: str
    aside: str


@dataclass(frozen=True)
class MeasureTable:
    """Measures of one family; ``kind`` is "grid" where rows are tolerances and columns are three shares.

    ``note`` says what a number stands for that is none; empty where there is no such number.
    """

    title: str
    kind: str
    heads: list[Head]
    rows: list[MeasureRow]
    meanings: list[Meaning]
    note: str = ""


@dataclass(frozen=True)
class ToleranceRow:
    """One line of a standard: pass rates, then capabilities, each native and scaled."""

    standard: str
    name: str
    limit_mm: Cell
    cells: list[Cell]


@dataclass(frozen=True)
class ExtendedConfig:
    """One config's extended measures, spelled; ``charts`` are captions and pictures."""

    name: str
    views: int
    charts: list[tuple[str, Markup]]
    first: MeasureTable
    more: MeasureTable
    tolerances: list[ToleranceRow]
    families: list[MeasureTable]

    def not_told(self) -> bool:
        """Return whether a capability is of what was not found."""
        return any(cell.text == NOT_TOLD for row in self.tolerances for cell in row.cells)


@dataclass(frozen=True)
class ExtendedSection:
    """All configs, and where the tolerances come from."""

    protocol: str
    configs: list[ExtendedConfig]
    profiles: tuple[ToleranceProfile, ...]


def extended_section(extended: ExtendedResult) -> ExtendedSection:
    """Return what ``part_extended.html.j2`` shows."""
    configs = [_config(name, table) for name, table in extended.tables.items()]
    return ExtendedSection(EXTENDED_PROTOCOL, configs, PROFILES)


def _config(name: str, table: ExtendedTable) -> ExtendedConfig:
    inspection = FAMILIES["inspection"]
    by_name = {measure.name: measure for measure in INSPECTION_MEASURES}
    passes = {pass_sample(tolerance) for profile in PROFILES for tolerance in profile.tolerances}
    rest = [one for one in INSPECTION_MEASURES if one.name not in passes and one.name not in FIRST]
    folded = [_folded(table, key) for key in _FOLDED]
    charts = [(_AXIS_TITLES[axis][0], _chart(table, axis)) for axis in AXES]
    return ExtendedConfig(
        name=wording.printable(name),
        views=table.views,
        charts=[(title, chart) for title, chart in charts if chart],
        first=_table(table, inspection.title, inspection, [by_name[one] for one in FIRST]),
        more=_table(table, "Inspection: spread, median, found bars alone", inspection, rest),
        tolerances=[_tolerance(table, *line) for line in _tolerance_lines()],
        families=[one for one in [*folded, _profile(table)] if one.rows],
    )


def _tolerance_lines() -> list[tuple[ToleranceProfile, Tolerance]]:
    return [(profile, tolerance) for profile in PROFILES for tolerance in profile.tolerances]


def _folded(table: ExtendedTable, key: str) -> MeasureTable:
    family = FAMILIES[key]
    if key == "clouds":
        return _clouds(table, family)
    return _table(table, family.title, family, family.measures, _ONCE_ASIDES.get(key, ""))


def _table(
    table: ExtendedTable, title: str, family: Family, measures: Iterable[Measure], once_aside: str = ""
) -> MeasureTable:
    listed = list(measures)
    heads = [Head(one, once_aside if one == ONCE else _ASIDES[one]) for one in family.alignments]
    rows = measure_rows(table, listed, family.alignments)
    return MeasureTable(title, "rows", heads, rows, meanings(listed), _miss_note(rows))


def _miss_note(rows: Iterable[MeasureRow]) -> str:
    missed = any(cell.text == MISSED for row in rows for cell in row.cells)
    return f"{MISSED}: {MISS_MM:g} mm, which stands for what was not found." if missed else ""


def _profile(table: ExtendedTable) -> MeasureTable:
    family = FAMILIES["profile"]
    return _table(table, f"{family.title}: the numbers", family, family.measures)


def _clouds(table: ExtendedTable, family: Family) -> MeasureTable:
    """Return a row per tolerance with accuracy, completeness and F-score, native and then scaled."""
    measures = {measure.name: measure for measure in family.measures}
    rows = []
    for tolerance_mm in TOLERANCES_MM:
        names = [f"cloud_{kind}_{tolerance_mm}mm" for kind in _CLOUD_KINDS]
        found = [
            (table.numbers[alignment][name], measures[name]) for alignment in family.alignments for name in names
        ]
        if any(one.samples for one, _ in found):
            cells = [estimate_cell(one, measure) for one, measure in found]
            rows.append(MeasureRow(f"{tolerance_mm}", "mm", "", cells, str(found[0][0].samples)))
    heads = [Head(one, _ASIDES[one]) for one in family.alignments]
    return MeasureTable(family.title, "grid", heads, rows, meanings(family.measures))


def _tolerance(table: ExtendedTable, profile: ToleranceProfile, tolerance: Tolerance) -> ToleranceRow:
    measures = {measure.name: measure for measure in FAMILIES["inspection"].measures}
    cells = [
        estimate_cell(table.numbers[alignment][name], measures[name])
        for name in (pass_sample(tolerance), capability_name(tolerance))
        for alignment in (NATIVE, SCALED)
    ]
    limit_mm = Cell(f"{tolerance.limit_mm:g}", tolerance.limit_mm)
    return ToleranceRow(profile.title, tolerance.title, limit_mm, cells)


def _chart(table: ExtendedTable, axis: str) -> Markup:
    native, scaled = table.numbers[NATIVE], table.numbers[SCALED]
    edges = AXES[axis]
    bins = [
        ProfileBin(
            low, high, native[f"abs_rel_at_{name}"], scaled[f"abs_rel_at_{name}"], native[f"scale_at_{name}"]
        )
        for (low, high), name in zip(pairwise(edges), bin_names(axis, edges), strict=True)
    ]
    return profile_chart(*_AXIS_TITLES[axis], bins)
