"""The benchmark card: what is measured, by which rules, with which limits. Its numbers come from the code."""

from __future__ import annotations

from cards.templates import render
from rebar_depth_bench.methods import METHODS
from rebar_depth_bench.protocol import DELTA1_RATIO, MIN_RANKED_COVERAGE, PROTOCOL, WITHIN_MM


def benchmark_card() -> str:
    """Return the text of ``cards/BENCHMARK.md``."""
    return render(
        "benchmark_card.md.j2",
        protocol=PROTOCOL,
        delta1_ratio=DELTA1_RATIO,
        min_ranked_coverage=MIN_RANKED_COVERAGE,
        within_mm=WITHIN_MM,
        methods=[method.info for method in METHODS.values()],
    )
