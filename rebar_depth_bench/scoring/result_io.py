"""Parser of result JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from rebar_depth_bench.errors import InputError
from rebar_depth_bench.scoring.metrics import DepthMetrics
from rebar_depth_bench.scoring.protocol import PROTOCOL
from rebar_depth_bench.scoring.result import VIEW_METRICS, Result, Table, ViewScore


def read_result(data: bytes, where: str) -> Result:
    """Return the result in ``data`` without extended measures; ``where`` names the source in error messages.

    Raises ``InputError`` if ``data`` is not a result of the current protocol.
    """
    try:
        document = json.loads(data)
        if document["protocol"] != PROTOCOL:
            raise InputError(f"{where}: the protocol is {document['protocol']!r}, expected {PROTOCOL!r}")
        return Result(
            method=document["submission"]["method"],
            submission_sha256=document["submission"]["sha256"],
            dataset_digest=document["dataset"]["digest"],
            dataset_version=document["dataset"]["version"],
            software_version=document["software"]["version"],
            tables={config: read_table(table) for config, table in document["tables"].items()},
            views=[_read_view(view) for view in document["views"]],
        )
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{where}: is not a rebar-bench result: {type(error).__name__}: {error}") from None


def read_table(table: Mapping[str, Any]) -> Table:
    """Return the table of a config from its JSON object."""
    return Table(
        views=table["views"],
        views_scored=table["views_scored"],
        coverage=table["coverage"],
        ranked=table["ranked"],
        native=_read_metrics(table["native"], table["views_scored"] > 0),
        scaled=_read_metrics(table["scaled"], table["views_scored"] > 0),
        scale_median=table["scale_median"],
        within_mm=_read_within_mm(table["within_mm"]),
        intervals={name: _read_interval(table.get("ci95", {}), name) for name in VIEW_METRICS},
    )


def _read_view(view: Mapping[str, Any]) -> ViewScore:
    predicted = view["coverage"] > 0
    return ViewScore(
        view_id=view["view_id"],
        scored_px=view["scored_px"],
        coverage=view["coverage"],
        scale=view["scale"],
        native=_read_metrics(view["native"], predicted),
        scaled=_read_metrics(view["scaled"], predicted),
        within_mm=_read_within_mm(view["within_mm"]),
    )


def _read_metrics(values: Mapping[str, float | None], predicted: bool) -> DepthMetrics | None:
    """Return the metrics, or None without predictions; with predictions, null denotes an overflow (``inf``)."""
    if not predicted:
        return None
    return DepthMetrics(**{name: math.inf if value is None else value for name, value in values.items()})


def _read_within_mm(within_mm: Mapping[str, Any]) -> dict[int, Any]:
    return {int(tolerance_mm): share for tolerance_mm, share in within_mm.items()}


def _read_interval(nested: Mapping[str, Any], name: str) -> tuple[float, float] | None:
    group, _, key = name.rpartition(".")
    bounds = (nested.get(group, {}) if group else nested).get(key)
    return None if bounds is None or None in bounds else (bounds[0], bounds[1])
