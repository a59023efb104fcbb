"""Baselines at crossings: rows of the card's tables, from the files that ``benchmarks.crossings`` writes."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from cards.reference import number, percent
from rebar_depth_bench.detections.matching import LIMITS_MM

FILES = ("crossings.json", "crossings-cages.json")
"""Files of results: of the scenes, and of generated scenes."""


def crossing_baselines(file: str) -> dict[str, Any]:
    """Return the template variables of the baselines in a file: command, renders, and rows of the tables."""
    document = json.loads((Path(__file__).parent / "reference" / file).read_text())
    depth = document["depth"]
    return {
        "file": f"cards/reference/{file}",
        "command": document["command"],
        "renders": document["renders"],
        "depth": [
            [config, f"`{method}`", *_depth_cells(entry)]
            for method, configs in depth.items()
            for config, entry in configs.items()
            if entry["measures"]["crossings_located"] is not None
        ],
        "detectors": [
            [config, method, *_detector_cells(table)]
            for method, configs in document["detectors"].items()
            for config, table in configs.items()
            if table["crossings"]
        ],
    }


def _depth_cells(entry: Mapping[str, Any]) -> Iterator[str]:
    measures = entry["measures"]
    yield from (str(entry["judged"]), percent(measures["crossings_located"]))
    yield from (number(measures[name], 2, " mm") for name in ("tie_median_mm", "tie_p95_mm"))
    yield from (percent(measures[f"tie_within_{limit}mm"]) for limit in (2, 5))


def _detector_cells(table: Mapping[str, Any]) -> Iterator[str]:
    chance = table["chance"]
    for name in ("precision", "recall", "f1"):
        yield f"{percent(table[name])} ({percent(chance[name])})"
    for limit_mm in LIMITS_MM:
        average = table["average_precision"][str(limit_mm)]
        yield f"{percent(average)} ({percent(chance[f'average_precision_{limit_mm}mm'])})"
    yield from (number(table[name], 2, " mm") for name in ("position_mm", "position_p95_mm"))
    yield ", ".join(number(table[name], 1) for name in ("right_bias_mm", "down_bias_mm", "along_bias_mm")) + " mm"
    yield number(table["spread_mm"], 1, " mm")
