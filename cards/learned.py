"""Tables with learned networks, from the numbers that ``benchmarks.learned`` writes.

The main table of a config has the bundled methods of a set of reference results, too.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from cards.reference import coverage_text, number, percent, reference_context, results_file

LEARNED = "learned"
"""Set of results of learned networks."""
OWN_NETWORK = "own-network"
"""Set of results of the network of ``examples/finetune.py``, written by ``benchmarks.own_network``."""


def learned_results(set_name: str = LEARNED) -> dict[str, Any]:
    """Return the stored numbers: ``command``, ``configs`` with their methods, and ``training`` of our network."""
    document: dict[str, Any] = json.loads(results_file(set_name).read_text())
    return document


def own_network_table(configs: Mapping[str, Any]) -> str:
    """Return the Markdown table of the network of ``examples/finetune.py`` beside its references."""
    head = ("config", "views", "method", "rank error", "AbsRel", "AbsRel scaled", "plane, scaled")
    rows = []
    for config, numbers in configs.items():
        for method, row in numbers["methods"].items():
            errors = [number(row[key], 4) for key in ("rank_error", "native", "scaled", "scaled_constant")]
            shares = (percent(row["within_5_mm"]), coverage_text(row["coverage"]))
            rows.append((config, str(numbers["views"]), f"`{method}`", *errors, *shares))
    return _markdown((*head, "within 5 mm", "coverage"), rows)


def baseline_tables(set_name: str) -> dict[str, str]:
    """Return the main table of each config of a set: bundled methods and learned networks, by rank error."""
    context, networks = reference_context(set_name), learned_results()["configs"]
    return {
        config: _baseline_table(config, rows, context["errors"][config], networks[config])
        for config, rows in context["rows"].items()
    }


def _baseline_table(
    config: str, bundled: Sequence[Mapping[str, str]], errors: Mapping[str, Any], networks: Mapping[str, Any]
) -> str:
    names = [row["method"] for row in bundled]
    learned = [
        {
            "method": method,
            "mark": _mark(row),
            "views": str(networks["views"]),
            "rank_error": number(row["rank_error"], 4),
            "coverage": coverage_text(row["coverage"]),
            "native": number(row["native"], 4),
            "scaled": number(row["scaled"], 4),
            "scale": number(row["scale"], 3),
            "within": percent(row["within_5_mm"]),
        }
        for method, row in _sorted(networks, "rank_error")
        if method not in names
    ]
    keys = ("views", "rank_error", "coverage", "native", "scaled", "scale", "within")
    head = (config, "views", "rank error", "coverage", "AbsRel", "AbsRel scaled", "s", "within 5 mm")
    ordered = sorted((*bundled, *learned), key=lambda row: (row["mark"], float(row["rank_error"])))
    rows = [[f"`{row['method']}`{row['mark']}", *(row[key] for key in keys)] for row in ordered]
    rows += [
        ["*constant, after scaling*", *[""] * 4, errors["constant"][0], *[""] * 2],
        ["*exact depth, one pixel beside*", *[""] * 3, errors["one_pixel"][0], *[""] * 3],
    ]
    return _markdown(head, rows)


def learned_tables(configs: Mapping[str, Any]) -> dict[str, str]:
    """Return the Markdown tables of each config: disparities, metric methods, and all methods after alignment."""
    return {
        name: "\n\n".join((_head(name, config), _metric_table(name, config), _aligned_table(name, config)))
        for name, config in configs.items()
    }


def _head(name: str, config: Mapping[str, Any]) -> str:
    low, middle, high = (number(value, 1) for value in config["disparity_px"])
    reach = "; ".join(
        f"up to {limit} px: {percent(reach['pixels'])} of the pixels, and all of them in {reach['views']} views"
        for limit, reach in config["reach"].items()
    )
    of_scenes = f" of {config['scenes']} scenes" if config["scenes"] > 1 else ""
    return (
        f"{name}: {config['views']} views{of_scenes}, {config['width']} x {config['height']}. "
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
        "plane, scaled",
        "s",
        "within 5 mm",
        "bias, px",
    )
    rows: list[tuple[str, ...]] = [
        (
            _title(method, row),
            number(row["rank_error"], 4),
            number(row["reached_rank_error"], 4),
            coverage_text(row["coverage"]),
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
    return f"`{method}`{_mark(row)}"


def _mark(row: Mapping[str, Any]) -> str:
    return " ‡" if row["uses_ground_truth"] else ""


def _markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    first, *others = [f"| {' | '.join(cells)} |" for cells in (head, *rows)]
    return "\n".join((first, "|---" * len(head) + "|", *others))
