"""The extended measures' part of the page: charts, inspection, tolerances, and the other families folded away.

Extended measures as rows of cells, and what each of them means in words.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

from markupsafe import Markup

from rebar_depth_bench.extended.evaluate import FAMILIES, NATIVE, ONCE, SCALED, Family
from rebar_depth_bench.extended.inspection.evaluate import MEASURES as INSPECTION_MEASURES
from rebar_depth_bench.extended.inspection.measures import MISS_MM, capability_name
from rebar_depth_bench.extended.inspection.tolerances import PROFILES, Tolerance, ToleranceProfile, pass_sample
from rebar_depth_bench.extended.measures import EXTENDED_PROTOCOL, Measure
from rebar_depth_bench.extended.point_cloud import TOLERANCES_MM
from rebar_depth_bench.extended.profiles import AXES, bin_names
from rebar_depth_bench.extended.result import Estimate, ExtendedResult, ExtendedTable
from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.reporting.charts.profile import ProfileBin, profile_chart
from rebar_depth_bench.reporting.extended_tables import MISSED, NOT_TOLD, is_miss
from rebar_depth_bench.reporting.formatting import DASH, number
from rebar_depth_bench.reporting.html.rows import Cell

_DECIMALS: Mapping[str, int] = {"mm": 2, "cm": 2, "m": 3, "%": 1, "": 4}
_RATIO_DECIMALS = 2
_ARROWS: Mapping[str, str] = {"lower": "↓", "higher": "↑", "": ""}
_STEP = re.compile(r"\d[\d.]*(?:-[\d.]+)?(?= (?:mm|%|m|px)(?!\w))")
"""The tolerance, threshold or bin in a measure's title: a number with a unit."""


@dataclass(frozen=True)
class MeasureRow:
    """One measure: a cell per alignment, and how many samples they stand on."""

    name: str
    unit: str
    better: str
    cells: list[Cell]
    samples: str


@dataclass(frozen=True)
class Meaning:
    """What a number, or numbers that differ by a tolerance or a bin alone, say."""

    name: str
    definition: str


def measure_rows(table: ExtendedTable, measures: Iterable[Measure], alignments: Sequence[str]) -> list[MeasureRow]:
    """Return a row for each measure that has a value under one of the ``alignments``, in the measures' order."""
    rows = []
    for measure in measures:
        found = [table.numbers[alignment][measure.name] for alignment in alignments]
        if any(one.samples for one in found):
            rows.append(_row(measure, found))
    return rows


def estimate_cell(one: Estimate, measure: Measure) -> Cell:
    """Return an estimate as its measure's unit spells it, with its interval."""
    factor = 100.0 if measure.unit == "%" else 1.0
    decimals = _decimals(measure)
    if one.value is None:
        return Cell(NOT_TOLD if one.samples else DASH, None)
    if not math.isfinite(one.value):
        return Cell("∞" if measure.convert is not None else DASH, None)
    if is_miss(one, measure):
        told = one.interval is not None and one.interval[0] < one.interval[1]
        return Cell(MISSED, one.value, _between(one.interval, factor, decimals) if told else "")
    return Cell(_signed(one.value * factor, decimals), one.value, _between(one.interval, factor, decimals))


def meanings(measures: Iterable[Measure]) -> list[Meaning]:
    """Return each measure's definition; measures that differ by a step alone share one, with N for the step."""
    alike: dict[str, list[Measure]] = {}
    for measure in measures:
        alike.setdefault(_STEP.sub("N", measure.title, count=1), []).append(measure)
    return [_meaning(title, same) for title, same in alike.items()]


def _decimals(measure: Measure) -> int:
    if measure.convert is not None or measure.name.endswith("_deg"):
        return _RATIO_DECIMALS
    return _DECIMALS[measure.unit]


def _meaning(title: str, same: Sequence[Measure]) -> Meaning:
    first = same[0]
    if len(same) == 1:
        return Meaning(first.title, first.definition)
    steps = [step[0] for one in same if (step := _STEP.search(one.title))]
    definition = _STEP.sub(lambda step: "N" if step[0] == steps[0] else step[0], first.definition)
    return Meaning(title, f"{definition}; N: {', '.join(steps)}")


def _row(measure: Measure, found: Sequence[Estimate]) -> MeasureRow:
    samples = list(dict.fromkeys(str(one.samples) for one in found))
    cells = [estimate_cell(one, measure) for one in found]
    return MeasureRow(measure.title, measure.unit, _ARROWS[measure.better], cells, " / ".join(samples))


def _between(ends: tuple[float, float] | None, factor: float, decimals: int) -> str:
    if ends is None or not all(map(math.isfinite, ends)):
        return ""
    joint = " to " if ends[0] < 0 else " – "
    return joint.join(_signed(end * factor, decimals) for end in ends)


def _signed(value: float, decimals: int) -> str:
    return number(value, decimals).replace("-", "−")


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
        name=formatting.printable(name),
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
