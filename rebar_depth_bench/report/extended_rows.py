"""Extended measures as rows of cells, and what each of them means in words."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from rebar_depth_bench.extended.measures import Measure
from rebar_depth_bench.extended.result import Estimate, ExtendedTable
from rebar_depth_bench.extended.table import MISSED, NOT_TOLD, is_miss
from rebar_depth_bench.report.rows import Cell
from rebar_depth_bench.wording import DASH, number

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
