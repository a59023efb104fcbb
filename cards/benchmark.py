"""The benchmark card: what is measured, by which rules, with which limits. Its numbers come from the code.

The benchmark card's tables of reference results, from the stored JSON.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cards.templates import render
from rebar_depth_bench.extended.evaluate import FAMILIES, ONCE, Family
from rebar_depth_bench.extended.inspection.tolerances import PROFILES
from rebar_depth_bench.extended.measures import EXTENDED_PROTOCOL, Measure
from rebar_depth_bench.methods import AnyMethod, MultiViewMethod, own_methods
from rebar_depth_bench.scoring.bootstrap import DRAWS, MIN_VIEWS, RING_VIEWS
from rebar_depth_bench.scoring.protocol import DELTA1_RATIO, MIN_RANKED_COVERAGE, PROTOCOL, WITHIN_MM

RESULTS = Path(__file__).parent / "reference.json"


def reference_context() -> dict[str, Any]:
    """Return what the card's template shows: the command, the subset, and each config's rows in words."""
    stored = json.loads(RESULTS.read_text())
    tables: dict[str, list[dict[str, str]]] = {}
    for method, result in stored["results"].items():
        for config, table in result["tables"].items():
            tables.setdefault(config, []).append(_reference_row(method, result, config, table))
    return {"command": stored["command"], "subset": stored["subset"], "reference": tables}


def _reference_row(
    method: str, result: Mapping[str, Any], config: str, table: Mapping[str, Any]
) -> dict[str, str]:
    native, scaled = table["native"] or {}, table["scaled"] or {}
    low_high = (table.get("ci95") or {}).get("native", {}).get("abs_rel")
    interval = "" if low_high is None else f" ({_number(low_high[0], 3)}-{_number(low_high[1], 3)})"
    return {
        "method": method,
        "mark": " †" if own_methods()[method].info.reads_truth else "",
        "coverage": _percent(table["coverage"]),
        "ranked": "yes" if table["ranked"] else "no",
        "abs_rel": _number(native.get("abs_rel"), 4) + interval,
        "rmse": _number(native.get("rmse_cm"), 2, " cm"),
        "scaled": _number(scaled.get("abs_rel"), 4),
        "scale": _number(table["scale_median"], 3),
        "within": _percent(table["within_mm"]["5"]),
        "seconds": _seconds(result, config, table["views"]),
    }


def _seconds(result: Mapping[str, Any], config: str, views: int) -> str:
    """Return the seconds a view takes, with its share of what was prepared for all of them."""
    spent = result["seconds"]
    preparing = (spent["preparing"] or {}).get(config, 0.0)
    return "-" if preparing is None else f"{spent['a_view'][config] + preparing / views:.2g}"


def _number(value: float | None, digits: int, unit: str = "") -> str:
    return "-" if value is None else f"{value:.{digits}f}{unit}"


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f} %"


_STEP = re.compile(r"(?<=_)\d[\d.]*(?:-[\d.]+)?(?=(?:mm|pct|m|px)$)")
"""The tolerance, threshold or bin that a measure's name ends with."""


def benchmark_card() -> str:
    """Return the text of ``cards/BENCHMARK.md``."""
    return render(
        "benchmark_card.md.j2",
        protocol=PROTOCOL,
        delta1_ratio=DELTA1_RATIO,
        min_ranked_coverage=MIN_RANKED_COVERAGE,
        within_mm=WITHIN_MM,
        methods=[_method_row(method) for method in own_methods().values()],
        **reference_context(),
        draws=DRAWS,
        ring_views=RING_VIEWS,
        min_views=MIN_VIEWS,
        extended_protocol=EXTENDED_PROTOCOL,
        families=[_family_rows(family) for family in FAMILIES.values()],
        profiles=PROFILES,
    )


def _method_row(method: AnyMethod) -> dict[str, str]:
    info = method.info
    name = f"`{info.name}`{' †' if info.reads_truth else ''}"
    what = f"{info.summary} ({info.unexercised})" if info.unexercised else info.summary
    needs = "all views of a config" if isinstance(method, MultiViewMethod) else ", ".join(info.columns)
    return {"name": name, "what": what, "needs": needs, "licence": info.licence}


def _family_rows(family: Family) -> dict[str, Any]:
    taken = "once" if family.alignments == (ONCE,) else "native and scaled"
    alike: dict[str, list[Measure]] = {}
    for measure in family.measures:
        alike.setdefault(_STEP.sub("N", measure.name), []).append(measure)
    return {"title": family.title, "taken": taken, "rows": [_row(name, same) for name, same in alike.items()]}


def _row(name: str, measures: Sequence[Measure]) -> dict[str, str]:
    """Return one row for measures that differ by a tolerance or a bin alone, which it calls N."""
    first, definition = measures[0], measures[0].definition
    step = _STEP.search(first.name)
    if step is not None:
        steps = ", ".join(found[0] for one in measures if (found := _STEP.search(one.name)))
        definition = f"{definition.replace(f' {step[0]} ', ' N ', 1)}; N = {steps}"
    return {
        "name": name,
        "unit": first.unit,
        "better": first.better,
        "statistic": first.statistic,
        "definition": definition.replace("|", r"\|"),
    }
