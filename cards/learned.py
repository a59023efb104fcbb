"""Tables of learned networks in the card, from the numbers that ``benchmarks.learned`` writes."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from cards.reference import number, percent, results_file

LEARNED = "learned"
"""Set of results of learned networks."""


def learned_context() -> dict[str, Any]:
    """Return the template variables of the section on learned networks: command and tables by config."""
    document = json.loads(results_file(LEARNED).read_text())
    return {"command": document["command"], "tables": learned_tables(document["configs"])}


def learned_tables(configs: Mapping[str, Any]) -> dict[str, str]:
    """Return the Markdown tables of each config: disparities, metric methods, and all methods after alignment."""
    return {
        name: "\n\n".join((_head(config), _metric_table(name, config), _aligned_table(name, config)))
        for name, config in configs.items()
    }


def _head(config: Mapping[str, Any]) -> str:
    low, middle, high = (number(value, 1) for value in config["disparity_px"])
    reach = "; ".join(
        f"up to {limit} px: {percent(reach['pixels'])} of the pixels, and all of them in {reach['views']} views"
        for limit, reach in config["reach"].items()
    )
    of_scenes = f" of {config['scenes']} scenes" if config["scenes"] > 1 else ""
    return (
        f"{config['views']} views{of_scenes}, {config['width']} x {config['height']}. "
        f"True disparities: {low} to {high} px, median {middle} px; {reach}."
    )


def _metric_table(name: str, config: Mapping[str, Any]) -> str:
    limit = next(iter(config["reach"]))
    head = (
        "rank error",
        f"only views up to {limit} px",
        "coverage",
        "AbsRel",
        "AbsRel scaled",
        "constant there",
        "s",
        "within 5 mm",
        "bias, px",
    )
    rows: list[tuple[str, ...]] = [
        (
            _title(method, row),
            number(row["rank_error"], 4),
            number(row["reached_rank_error"], 4),
            percent(row["coverage"]),
            number(row["native"], 4),
            number(row["scaled"], 4),
            number(row["scaled_constant"], 4),
            number(row["scale"], 3),
            percent(row["within_5_mm"]),
            number(row["bias_px"], 2),
        )
        for method, row in _sorted(config, "rank_error")
    ]
    constant, one_pixel = (number(config[key], 4) for key in ("constant", "one_pixel"))
    rows += [
        ("*constant, after scaling*", *[""] * 4, constant, *[""] * 4),
        ("*exact depth, one pixel beside*", *[""] * 3, one_pixel, *[""] * 5),
    ]
    return _markdown((name, *head), rows)


def _aligned_table(name: str, config: Mapping[str, Any]) -> str:
    head = ("aligned error", "aligned AbsRel", "constant: error", "constant: AbsRel", "views without slope")
    rows = [
        (
            _title(method, row),
            number(row["aligned_error"], 4),
            number(row["aligned"], 4),
            number(row["aligned_constant_error"], 4),
            number(row["aligned_constant"], 4),
            f"{row['flat_views']} of {config['views']}",
        )
        for method, row in _sorted(config, "aligned_error")
    ]
    return _markdown((f"{name}, as affine disparity", *head), rows)


def _sorted(config: Mapping[str, Any], key: str) -> list[tuple[str, Mapping[str, Any]]]:
    """Return the methods that have the number ``key``, by it; those that use ground truth come last."""
    rows = [(method, row) for method, row in config["methods"].items() if row[key] is not None]
    return sorted(rows, key=lambda item: (bool(item[1]["uses_ground_truth"]), item[1][key]))


def _title(method: str, row: Mapping[str, Any]) -> str:
    return f"`{method}`{' †' if row['uses_ground_truth'] else ''}"


def _markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    first, *others = [f"| {' | '.join(cells)} |" for cells in (head, *rows)]
    return "\n".join((first, "|---" * len(head) + "|", *others))
