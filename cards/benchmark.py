"""Benchmark card: metrics, protocol, limits, methods and reference results.

The constants of the card are taken from the code, the tables of results from the JSON files of this package.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

from cards.crossings import FILES, crossing_baselines
from cards.learned import learned_context
from cards.reference import (
    CAGES,
    FULL_SETS,
    GROUPS_METHOD,
    SUBSET,
    group_tables,
    number,
    percent,
    reference_context,
)
from cards.steel import STEEL_RESULTS, depth_text, range_text
from cards.templates import render
from rebar_depth_bench.bar_crossings.definition import crossing_parameters
from rebar_depth_bench.detections.reading import MAX_ROWS_PER_VIEW
from rebar_depth_bench.extended.inspection import PROFILES
from rebar_depth_bench.extended.measures import EXTENDED_PROTOCOL, ONCE, Measure, MeasureFamily
from rebar_depth_bench.extended.registry import MEASURE_FAMILIES
from rebar_depth_bench.methods import AnyMethod, MultiViewMethod, own_methods
from rebar_depth_bench.reporting.extended_tables import FITS_NOTE, REACH_NOTE
from rebar_depth_bench.scoring.bootstrap import BLOCK_VIEWS, INTERVALS, MIN_BLOCKS, RESAMPLES
from rebar_depth_bench.scoring.columns import SIGNIFICANT_DIGITS
from rebar_depth_bench.scoring.groups import GROUPINGS
from rebar_depth_bench.scoring.protocol import (
    DELTA1_RATIO,
    MIN_COMPARABLE_COVERAGE,
    PROTOCOL,
    RELATIVE_PROTOCOL,
    WITHIN_MM,
)
from rebar_depth_bench.scoring.relative import LEAST_GAIN
from rebar_depth_bench.submission import INPUTS

_CONTACTS = {"lattice": "375", "pier": "4,860", "pile": "15"}
"""Numbers of crossings of the scenes, as `tests/builder/catalog/test_configs.py` expects them."""


def steel_context() -> dict[str, Any]:
    """Return the template variables of the steel in the full protocols: command, image size and rows."""
    document = json.loads(STEEL_RESULTS.read_text())
    sizes = {f"{entry['width']} x {entry['height']}" for entry in document["configs"].values()}
    rows = [_steel_row(name, entry) for name, entry in document["configs"].items()]
    return {"steel_command": document["command"], "steel_size": " or ".join(sorted(sizes)), "steel": rows}


def _steel_row(name: str, entry: Mapping[str, Any]) -> dict[str, str]:
    coverage, single = entry["coverage"], entry["single_bar"]
    without = entry["scored_views"] - single["views"]
    least_and_most = range_text(100 * coverage["least"], 100 * coverage["most"], 1)
    return {
        "name": name,
        "scored": f"{entry['scored_views']} of {entry['views']}",
        "coverage": f"{percent(coverage['mean'])} ({least_and_most})",
        "interior": percent(entry["interior"]),
        "depth": depth_text(entry),
        "single_bar": percent(single["share"])
        + (f", none in {without} of {entry['views']} views" if without else ""),
        **{key: _errors(entry["reference"][key]) for key in ("constant", "one_pixel")},
    }


def _errors(errors: Mapping[str, float]) -> str:
    rmse_cm = errors["rmse_cm"]
    return f"{errors['abs_rel']:.3f}, {number(rmse_cm, 1 if rmse_cm < 10 else 0, ' cm')}"


_PARAMETER = re.compile(r"(?<=_)\d[\d.]*(?:-[\d.]+)?(?=(?:mm|pct|m|px|deg)$)")
"""Pattern of the tolerance, threshold or bin at the end of a measure's name, without its unit."""


def benchmark_card() -> str:
    """Return the text of ``cards/BENCHMARK.md``."""
    return render(
        "benchmark_card.md.j2",
        protocol=PROTOCOL,
        relative_protocol=RELATIVE_PROTOCOL,
        least_gain=LEAST_GAIN,
        delta1_ratio=DELTA1_RATIO,
        min_comparable_coverage=MIN_COMPARABLE_COVERAGE,
        significant_digits=SIGNIFICANT_DIGITS,
        inputs=[f"`{name}`" for name in INPUTS],
        within_mm=WITHIN_MM,
        methods=[_method_row(method) for method in own_methods().values()],
        subset=reference_context(SUBSET),
        full=[reference_context(name) for name in FULL_SETS],
        cages=reference_context(CAGES),
        cage_groups=group_tables(CAGES, "cages"),
        groups_method=GROUPS_METHOD,
        learned=learned_context(),
        **steel_context(),
        draws=RESAMPLES,
        ring_views=BLOCK_VIEWS,
        min_blocks=MIN_BLOCKS,
        interval_method=INTERVALS["method"],
        groupings=GROUPINGS,
        extended_protocol=EXTENDED_PROTOCOL,
        crossings=crossing_parameters(),
        fits_note=FITS_NOTE,
        reach_note=REACH_NOTE,
        contacts=_CONTACTS,
        baselines=[crossing_baselines(file) for file in FILES],
        random_points=60,
        max_rows=f"{MAX_ROWS_PER_VIEW:,}",
        families=[_family_rows(family) for family in MEASURE_FAMILIES.values()],
        profiles=PROFILES,
    )


def _method_row(method: AnyMethod) -> dict[str, str]:
    info = method.info
    name = f"`{info.name}`{' †' if info.uses_ground_truth else ''}"
    what = f"{info.summary} ({info.untested_note})" if info.untested_note else info.summary
    needs = "a whole config" if isinstance(method, MultiViewMethod) else ", ".join(info.columns)
    return {"name": name, "what": what, "needs": needs, "licence": info.licence}


def _family_rows(family: MeasureFamily) -> dict[str, Any]:
    alignment = "once" if family.alignments == (ONCE,) else "native and scaled"
    measures_by_name: dict[str, list[Measure]] = {}
    for measure in family.measures:
        measures_by_name.setdefault(_PARAMETER.sub("N", measure.name), []).append(measure)
    return {
        "title": family.title,
        "taken": alignment,
        "rows": [_measure_row(name, variants) for name, variants in measures_by_name.items()],
    }


def _measure_row(name: str, measures: Sequence[Measure]) -> dict[str, str]:
    """Return one row for measures that differ only in the tolerance or bin of their name, written as N."""
    first, definition = measures[0], measures[0].definition
    parameter = _PARAMETER.search(first.name)
    if parameter is not None:
        values = ", ".join(match[0] for measure in measures if (match := _PARAMETER.search(measure.name)))
        pattern = rf" {re.escape(parameter[0])} (?=mm|m\b|px|%|degrees)"
        definition = f"{re.sub(pattern, ' N ', definition, count=1)}; N = {values}"
    return {
        "name": name,
        "unit": first.unit,
        "better": first.better,
        "statistic": first.statistic,
        "definition": definition.replace("|", r"\|"),
    }
