"""The benchmark card: what is measured, by which rules, with which limits. Its numbers come from the code."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from cards.reference_table import reference_context
from cards.templates import render
from rebar_depth_bench.bootstrap import DRAWS, MIN_VIEWS, RING_VIEWS
from rebar_depth_bench.extended.evaluation import FAMILIES, ONCE, Family
from rebar_depth_bench.extended.measures import EXTENDED_PROTOCOL, Measure
from rebar_depth_bench.extended.tolerances import PROFILES
from rebar_depth_bench.methods import AnyMethod, MultiViewMethod, own_methods
from rebar_depth_bench.protocol import DELTA1_RATIO, MIN_RANKED_COVERAGE, PROTOCOL, WITHIN_MM

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
