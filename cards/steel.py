"""Steel in all views of the standard configs: ``cards/steel.json``, written by ``benchmarks.steel_coverage``."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

STEEL_RESULTS = Path(__file__).parent / "steel.json"
"""JSON file of the numbers of each config."""


def steel_by_config() -> dict[str, Mapping[str, Any]]:
    """Return the entry of each config in ``STEEL_RESULTS``, by its name."""
    configs: dict[str, Mapping[str, Any]] = json.loads(STEEL_RESULTS.read_text())["configs"]
    return configs


def depth_text(entry: Mapping[str, Any]) -> str:
    """Return the range of steel depth of an entry, to the centimetre or, on the pier, to the decimetre."""
    low_m, high_m = entry["depth_m"]
    return f"{range_text(low_m, high_m, 1 if high_m > 10 else 2)} m"


def range_text(low: float, high: float, decimals: int) -> str:
    """Return two numbers with a dash between them."""
    return f"{low:.{decimals}f}-{high:.{decimals}f}"
