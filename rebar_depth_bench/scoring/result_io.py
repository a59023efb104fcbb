"""A result read back from the bytes of its JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from rebar_depth_bench.errors import InputError
from rebar_depth_bench.scoring.metrics import DepthMetrics
from rebar_depth_bench.scoring.protocol import PROTOCOL
from rebar_depth_bench.scoring.result import VIEW_NUMBERS, Result, Table, ViewScore


def read_result(data: bytes, where: str) -> Result:
    """Return a result with its tables and views, without extended measures; ``where`` names it in the error.

    Raises ``InputError`` for what is no result of this protocol.
    """
    try:
        found = json.loads(data)
        if found["protocol"] != PROTOCOL:
            raise InputError(f"{where}: the protocol is {found['protocol']!r}, expected {PROTOCOL!r}")
        return Result(
            method=found["submission"]["method"],
            submission_sha256=found["submission"]["sha256"],
            dataset_digest=found["dataset"]["digest"],
            dataset_version=found["dataset"]["version"],
            software_version=found["software"]["version"],
            tables={config: read_table(table) for config, table in found["tables"].items()},
            views=[_view(view) for view in found["views"]],
        )
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{where}: is no result of rebar-bench: {type(error).__name__}: {error}") from None


def read_table(found: Mapping[str, Any]) -> Table:
    """Return a config's table from its object in the JSON."""
    return Table(
        views=found["views"],
        views_scored=found["views_scored"],
        coverage=found["coverage"],
        ranked=found["ranked"],
        native=_metrics(found["native"], found["views_scored"] > 0),
        scaled=_metrics(found["scaled"], found["views_scored"] > 0),
        scale_median=found["scale_median"],
        within_mm=_within(found["within_mm"]),
        intervals={name: _ends(found.get("ci95", {}), name) for name in VIEW_NUMBERS},
    )


def _view(found: Mapping[str, Any]) -> ViewScore:
    predicted = found["coverage"] > 0
    return ViewScore(
        view_id=found["view_id"],
        scored_px=found["scored_px"],
        coverage=found["coverage"],
        scale=found["scale"],
        native=_metrics(found["native"], predicted),
        scaled=_metrics(found["scaled"], predicted),
        within_mm=_within(found["within_mm"]),
    )


def _metrics(found: Mapping[str, float | None], predicted: bool) -> DepthMetrics | None:
    """Return metrics; where there is a prediction, a number that is null has overflowed."""
    if not predicted:
        return None
    return DepthMetrics(**{name: math.inf if value is None else value for name, value in found.items()})


def _within(found: Mapping[str, Any]) -> dict[int, Any]:
    return {int(tolerance_mm): share for tolerance_mm, share in found.items()}


def _ends(nested: Mapping[str, Any], name: str) -> tuple[float, float] | None:
    group, _, key = name.rpartition(".")
    ends = (nested.get(group, {}) if group else nested).get(key)
    return None if ends is None or None in ends else (ends[0], ends[1])
