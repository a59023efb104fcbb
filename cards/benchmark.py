"""Benchmark card, its two further pages (definitions of measures, long tables of results), and README's table.

The constants of the pages are taken from the code, the tables of results from the JSON files of this package.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from cards.crossings import FILES, crossing_baselines
from cards.learned import OWN_NETWORK, baseline_tables, learned_results, learned_tables, own_network_table
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
    results_file,
)
from cards.steel import STEEL_RESULTS, depth_text, range_text
from cards.templates import render, wrapped
from rebar_depth_bench.bar_crossings.definition import crossing_parameters
from rebar_depth_bench.detections.matching import DETECTIONS_PROTOCOL, HEADLINE_MM
from rebar_depth_bench.detections.reading import MAX_ROWS_PER_VIEW
from rebar_depth_bench.extended import working_range
from rebar_depth_bench.extended.families import MEASURE_FAMILIES
from rebar_depth_bench.extended.fits import MISS_MM
from rebar_depth_bench.extended.inspection import MISSED_NOTE
from rebar_depth_bench.extended.judged import MAX_SURFACE_DIAMETERS
from rebar_depth_bench.extended.measures import EXTENDED_PROTOCOL
from rebar_depth_bench.methods import AnyMethod, own_methods
from rebar_depth_bench.reporting.extended_tables import FITS_NOTE
from rebar_depth_bench.reporting.published import load_published
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


def benchmark_card() -> str:
    """Return the text of ``cards/BENCHMARK.md``: task, data, protocol, main results and limits."""
    subset, cages, networks = reference_context(SUBSET), reference_context(CAGES), learned_results()["configs"]
    own = learned_results(OWN_NETWORK)
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
        own=own,
        own_table=own_network_table(own["configs"]),
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
        families=MEASURE_FAMILIES.values(),
        miss_mm=MISS_MM,
        missed_note=MISSED_NOTE,
        crossings=crossing_parameters(),
        fits_note=FITS_NOTE,
        ranges=working_range,
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


def readme() -> str:
    """Return README.md with a new table of methods between its marks; ``ValueError`` without these marks."""
    table = render(
        "readme_table.md.j2",
        published=load_published().scenes,
        subset=json.loads(results_file(SUBSET).read_text()),
        networks=learned_results()["configs"],
        number=number,
    )
    marks = r"(?<=<!-- methods -->\n\n).*(?=\n\n<!-- end of methods -->)"
    before, after = re.split(marks, (_ROOT / "README.md").read_text(), flags=re.DOTALL)
    return before + table.strip() + after


PAGES: Mapping[Path, Callable[[], str]] = {
    _ROOT / "cards" / "BENCHMARK.md": benchmark_card,
    _ROOT / "docs" / "measures.md": measures_page,
    _ROOT / "docs" / "results.md": results_page,
    _ROOT / "README.md": readme,
}
"""Generated pages of the repository, and the functions that return their texts."""


def _method_row(method: AnyMethod) -> dict[str, str]:
    info = method.info
    name = f"`{info.name}`{' ‡' if info.uses_ground_truth else ''}"
    what = f"{info.summary} ({info.untested_note})" if info.untested_note else info.summary
    needs = ", ".join(info.columns) or ("all views of a config" if info.inputs == "multi-view" else "nothing")
    return {"name": name, "what": what, "needs": needs, "licence": info.licence}
