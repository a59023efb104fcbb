"""The benchmark card's tables of reference results, from the stored JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rebar_depth_bench.methods import own_methods

RESULTS = Path(__file__).parent / "reference.json"


def reference_context() -> dict[str, Any]:
    """Return what the card's template shows: the command, the subset, and each config's rows in words."""
    stored = json.loads(RESULTS.read_text())
    tables: dict[str, list[dict[str, str]]] = {}
    for method, result in stored["results"].items():
        for config, table in result["tables"].items():
            tables.setdefault(config, []).append(_row(method, result, config, table))
    return {"command": stored["command"], "subset": stored["subset"], "reference": tables}


def _row(method: str, result: Mapping[str, Any], config: str, table: Mapping[str, Any]) -> dict[str, str]:
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
