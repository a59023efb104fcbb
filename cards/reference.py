"""Reference results: rows of the card's tables, from the files that ``benchmarks.reference`` writes."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rebar_depth_bench.methods import own_methods
from rebar_depth_bench.scoring.columns import coverage_percent

SUBSET = "subset"
"""Set of results of all methods on a subset of the views of three scenes."""

FULL_SETS = ("lattice", "pile", "pier")
"""Published sets of results of the fast methods on all views of a scene, each named after its config."""

CAGES = "cages"
"""Set of results of the fast methods on generated scenes."""

GROUPS_METHOD = "sgbm"
"""Method whose results the card shows for each group of views."""


def results_file(set_name: str) -> Path:
    """Return the JSON file of a set of results."""
    return Path(__file__).parent / "reference" / f"{set_name}.json"


def reference_context(set_name: str) -> dict[str, Any]:
    """Return the template variables of a set of results: command, renders, and rows by config."""
    document = json.loads(results_file(set_name).read_text())
    by_config: dict[str, list[tuple[str, Mapping[str, Any]]]] = {}
    for method, result in document["results"].items():
        for config in result["tables"]:
            by_config.setdefault(config, []).append((method, result))
    return {
        "command": document["command"],
        "renders": document["renders"],
        "rows": {config: _method_rows(config, rows) for config, rows in by_config.items()},
        "errors": {
            config: {
                name: [number(errors["abs_rel"], 4), number(errors["rmse_cm"], 2)]
                for name, errors in rows[0][1]["tables"][config]["reference"].items()
            }
            for config, rows in by_config.items()
        },
        "single_bar": [_single_bar_row(config, *row) for config, rows in by_config.items() for row in rows],
    }


def group_tables(set_name: str, config: str) -> dict[str, list[dict[str, str]]]:
    """Return the formatted rows of groups of views, of the method ``GROUPS_METHOD``, by key of the grouping."""
    document = json.loads(results_file(set_name).read_text())
    groups = document["results"][GROUPS_METHOD]["tables"][config]["groups"]
    return {
        grouping: [_group_row(group, table) for group, table in tables.items()]
        for grouping, tables in groups.items()
    }


def _group_row(group: str, table: Mapping[str, Any]) -> dict[str, str]:
    reference = {name: number(errors["abs_rel"], 4) for name, errors in table["reference"].items()}
    return {"group": group, "views": str(table["views"]), **_table_cells(table), **reference}


def _method_rows(config: str, rows: Sequence[tuple[str, Mapping[str, Any]]]) -> list[dict[str, str]]:
    """Return the formatted rows of a config by rank error; those that are not ranked come last."""
    ordered = sorted(rows, key=lambda row: _rank_key(row[1]["tables"][config]))
    return [_method_row_of(method, result, config) for method, result in ordered]


def _rank_key(table: Mapping[str, Any]) -> tuple[bool, float]:
    return not table["ranked"], table["rank_error"]


def _single_bar_row(config: str, method: str, result: Mapping[str, Any]) -> dict[str, Any]:
    numbers = result["single_bar"][config]
    errors = {name: number(value, 4) for name, value in numbers.items() if "_abs_rel_" in name}
    return {
        "config": config,
        "method": method,
        "mark": _mark(method),
        "share": percent(numbers["share"]),
        "views": numbers["views"],
        **errors,
    }


def _mark(method: str) -> str:
    return " ‡" if own_methods()[method].info.uses_ground_truth else ""


def _method_row_of(method: str, result: Mapping[str, Any], config: str) -> dict[str, str]:
    table = result["tables"][config]
    return {
        "method": method,
        "mark": _mark(method),
        "views": str(table["views"]),
        **_table_cells(table),
        "seconds": _seconds(result, config, table["views"]),
    }


def _table_cells(table: Mapping[str, Any]) -> dict[str, str]:
    """Return the formatted numbers of the table of a config or of a group of its views."""
    native, scaled = table["native"] or {}, table["scaled"] or {}
    bounds = (table.get("ci95") or {}).get("native", {}).get("abs_rel")
    interval = "" if bounds is None else f" ({number(bounds[0], 3)}-{number(bounds[1], 3)})"
    return {
        "rank_error": number(table["rank_error"], 4),
        "coverage": coverage_text(table["coverage"]),
        "native": number(native.get("abs_rel"), 4),
        "abs_rel": number(native.get("abs_rel"), 4) + interval,
        "rmse": number(native.get("rmse_cm"), 2),
        "scaled": number(scaled.get("abs_rel"), 4),
        "scale": number(table["scale_median"], 3),
        "within": percent(table["within_mm"]["5"]),
    }


def _seconds(result: Mapping[str, Any], config: str, views: int) -> str:
    """Return the formatted seconds per view, including an equal share of the preparation; "-" if unknown."""
    seconds = result["seconds"]
    preparing = (seconds["preparing"] or {}).get(config, 0.0)
    return "-" if preparing is None else f"{seconds['a_view'][config] + preparing / views:.2g}"


def number(value: float | None, digits: int, unit: str = "") -> str:
    """Return a number with a fixed number of decimals; "-" for None."""
    return "-" if value is None else f"{value:.{digits}f}{unit}"


def percent(share: float | None) -> str:
    """Return a share in per cent with one decimal; "-" for None."""
    return "-" if share is None else f"{100 * share:.1f} %"


def coverage_text(share: float | None) -> str:
    """Return a coverage in per cent, rounded down as in results; "-" for None."""
    return "-" if share is None else f"{coverage_percent(share)} %"
