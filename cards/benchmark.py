"""Benchmark card and its two further pages: definitions of measures, and the long tables of results.

The constants of the pages are taken from the code, the tables of results from the JSON files of this package.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from cards.crossings import FILES, crossing_baselines
from cards.learned import baseline_tables, learned_results, learned_tables
from cards.reference import (
    CAGES,
    FULL_SETS,
    GROUPS_METHOD,
    SUBSET,
    coverage_text,
    group_tables,
    number,
    percent,
    reference_context,
)
from cards.steel import STEEL_RESULTS, depth_text, range_text
from cards.templates import render, wrapped
from rebar_depth_bench.bar_crossings.definition import crossing_parameters
from rebar_depth_bench.detections.matching import DETECTIONS_PROTOCOL, HEADLINE_MM
from rebar_depth_bench.detections.reading import MAX_ROWS_PER_VIEW
from rebar_depth_bench.extended.families import MEASURE_FAMILIES
from rebar_depth_bench.extended.fits import MISS_MM
from rebar_depth_bench.extended.inspection import MISSED_NOTE, PROFILES, TOLERANCES
from rebar_depth_bench.extended.judged import MAX_SURFACE_DIAMETERS
from rebar_depth_bench.extended.measures import EXTENDED_PROTOCOL, ONCE, Measure, MeasureFamily
from rebar_depth_bench.methods import AnyMethod, own_methods
from rebar_depth_bench.reporting.extended_tables import FITS_NOTE, REACH_NOTE
from rebar_depth_bench.scoring.bootstrap import BLOCK_VIEWS, INTERVALS, MIN_BLOCKS, RESAMPLES
from rebar_depth_bench.scoring.columns import SIGNIFICANT_DIGITS
from rebar_depth_bench.scoring.formatting import LEAST_MARGIN
from rebar_depth_bench.scoring.groups import GROUPINGS
from rebar_depth_bench.scoring.protocol import (
    DELTA1_RATIO,
    MIN_COMPARABLE_COVERAGE,
    PROTOCOL,
    RELATIVE_PROTOCOL,
    WITHIN_MM,
)

_ROOT = Path(__file__).parents[1]
_CONTACTS = {"lattice": "375", "pier": "4,860", "pile": "15"}
"""Numbers of crossings of the scenes, as `tests/builder/catalog/test_configs.py` expects them."""


def steel_context() -> dict[str, Any]:
    """Return the template variables of the steel in the full trajectories: command, image size and rows."""
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
        "views": str(entry["views"]),
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

_SHARED_PART = 0.7
"""Least share of the words of definitions that end alike, from which on they stand in one row."""


def benchmark_card() -> str:
    """Return the text of ``cards/BENCHMARK.md``: task, data, protocol, main results and limits."""
    subset, cages, networks = reference_context(SUBSET), reference_context(CAGES), learned_results()["configs"]
    text = render(
        "benchmark_card.md.j2",
        protocol=PROTOCOL,
        relative_protocol=RELATIVE_PROTOCOL,
        most_of_constant=1 - LEAST_MARGIN,
        delta1_ratio=DELTA1_RATIO,
        min_comparable_coverage=MIN_COMPARABLE_COVERAGE,
        significant_digits=SIGNIFICANT_DIGITS,
        within_mm=WITHIN_MM,
        draws=RESAMPLES,
        ring_views=BLOCK_VIEWS,
        min_blocks=MIN_BLOCKS,
        interval_method=INTERVALS["method"],
        scenes=FULL_SETS,
        subset=subset,
        cages=cages,
        baselines={**baseline_tables(SUBSET), **baseline_tables(CAGES)},
        networks=networks,
        same_views=(networks["lattice"]["views"], networks["cages"]["views"])
        == (subset["renders"]["views"], cages["renders"]["views"]),
        number=number,
        percent=percent,
        coverage_text=coverage_text,
        **steel_context(),
    )
    return wrapped(text)


def measures_page() -> str:
    """Return the text of ``docs/measures.md``: groups of views, extended measures and crossings."""
    text = render(
        "measures.md.j2",
        protocol=PROTOCOL,
        extended_protocol=EXTENDED_PROTOCOL,
        groupings=GROUPINGS,
        families=[_family_rows(family) for family in MEASURE_FAMILIES.values()],
        profiles=PROFILES,
        miss_mm=MISS_MM,
        missed_note=MISSED_NOTE,
        crossings=crossing_parameters(),
        fits_note=FITS_NOTE,
        reach_note=REACH_NOTE,
        contacts=_CONTACTS,
        max_rows=f"{MAX_ROWS_PER_VIEW:,}",
        detections_protocol=DETECTIONS_PROTOCOL,
        headline_mm=HEADLINE_MM,
        max_surface_diameters=MAX_SURFACE_DIAMETERS,
    )
    return wrapped(text)


def results_page() -> str:
    """Return the text of ``docs/results.md``: the long tables of results and how to repeat them."""
    learned = learned_results()
    text = render(
        "results.md.j2",
        full=[reference_context(name) for name in FULL_SETS],
        subset=reference_context(SUBSET),
        cages=reference_context(CAGES),
        cage_groups=group_tables(CAGES, "cages"),
        groupings=GROUPINGS,
        groups_method=GROUPS_METHOD,
        learned_command=learned["command"],
        learned_tables=learned_tables(learned["configs"]),
        crossing_baselines=[crossing_baselines(file) for file in FILES],
        random_points=60,
        ring_views=BLOCK_VIEWS,
        methods=[_method_row(method) for method in own_methods().values()],
        **steel_context(),
    )
    return wrapped(text)


PAGES: Mapping[Path, Callable[[], str]] = {
    _ROOT / "cards" / "BENCHMARK.md": benchmark_card,
    _ROOT / "docs" / "measures.md": measures_page,
    _ROOT / "docs" / "results.md": results_page,
}
"""Generated pages of the repository, and the functions that return their texts."""


def _method_row(method: AnyMethod) -> dict[str, str]:
    info = method.info
    name = f"`{info.name}`{' ‡' if info.uses_ground_truth else ''}"
    what = f"{info.summary} ({info.untested_note})" if info.untested_note else info.summary
    needs = ", ".join(info.columns) or ("all views of a config" if info.inputs == "multi-view" else "nothing")
    return {"name": name, "what": what, "needs": needs, "licence": info.licence}


def _family_rows(family: MeasureFamily) -> dict[str, Any]:
    """Return title, alignment and rows of a family, without the measures that tolerances have besides."""
    of_tolerances = {name for _, one in TOLERANCES for name in (one.pass_name, one.capability_name)}
    by_name: dict[str, list[Measure]] = {}
    for measure in family.measures:
        if measure.name not in of_tolerances:
            by_name.setdefault(_PARAMETER.sub("N", measure.name), []).append(measure)
    groups: list[list[dict[str, str]]] = []
    for name, variants in by_name.items():
        row = _measure_row(name, variants)
        for group in groups:
            if _common_end(one["definition"] for one in (row, *group)):
                group.append(row)
                break
        else:
            groups.append([row])
    return {
        "title": family.title,
        "taken": "once" if family.alignments == (ONCE,) else "native and scaled",
        "rows": [_merged(group) for group in groups],
        "tolerances": not of_tolerances.isdisjoint(family.by_name),
    }


def _common_end(definitions: Iterable[str]) -> int:
    """Return the number of words with which all definitions end; 0 if that is a small part of one of them."""
    words = [definition.split() for definition in definitions]
    common = _equal_at_the_start([one[::-1] for one in words])
    return common if common >= _SHARED_PART * max(map(len, words)) else 0


def _equal_at_the_start(texts: Sequence[Sequence[str]]) -> int:
    """Return the number of words with which all texts begin."""
    columns = enumerate(zip(*texts, strict=False))
    return next((place for place, words in columns if len(set(words)) > 1), min(map(len, texts)))


def _merged(rows: Sequence[Mapping[str, str]]) -> dict[str, Any]:
    """Return one row for measures whose definitions end alike: their names, and what differs in brackets."""
    names = [f"`{row['name']}`" for row in rows]
    if len(rows) == 1:
        return {**rows[0], "names": names}
    words = [row["definition"].split() for row in rows]
    end = _common_end(row["definition"] for row in rows)
    beginnings = [one[:-end] for one in words]
    start = _equal_at_the_start(beginnings)
    *_, last = texts = [" ".join(one[start:]) or "all" for one in beginnings]
    listed = "; ".join(text.rstrip(",:") for text in texts)
    alternatives = f"[{listed}]{last[len(last.rstrip(',:')) :]}"
    columns = {key: [row[key] or "-" for row in rows] for key in ("unit", "better", "statistic")}
    return {
        "names": names,
        "title": rows[0]["title"] if len({row["title"] for row in rows}) == 1 else "",
        "definition": " ".join((*words[0][:start], alternatives, *words[0][-end:])),
        **{
            key: " / ".join(cells) if len(set(cells)) > 1 else cells[0].strip("-")
            for key, cells in columns.items()
        },
    }


def _measure_row(name: str, measures: Sequence[Measure]) -> dict[str, str]:
    """Return one row for measures that differ only in the tolerance or bin of their name, written as N."""
    first, definition = measures[0], measures[0].definition.removesuffix(f" {MISSED_NOTE}")
    parameter = _PARAMETER.search(first.name)
    if parameter is not None:
        values = ", ".join(match[0] for measure in measures if (match := _PARAMETER.search(measure.name)))
        pattern = rf" {re.escape(parameter[0])} (?=mm|m\b|px|%|degrees)"
        definition = f"{re.sub(pattern, ' N ', definition, count=1)}; N = {values}"
    return {
        "name": name,
        "title": first.title.partition(":")[0] if ":" in first.title and parameter is None else "",
        "unit": first.unit,
        "better": first.better,
        "statistic": first.statistic,
        "definition": definition.replace("|", r"\|"),
    }
