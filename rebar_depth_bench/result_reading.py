"""A result read back from the bytes of its JSON, as far as tables show it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from rebar_depth_bench.errors import InputError
from rebar_depth_bench.metrics import DepthMetrics
from rebar_depth_bench.protocol import PROTOCOL
from rebar_depth_bench.result import VIEW_NUMBERS, Result, Table


def read_result(data: bytes, where: str) -> Result:
    """Return a result's stamps and tables, without its views; ``where`` names it in the error.

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
            tables={config: _table(table) for config, table in found["tables"].items()},
            views=(),
        )
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{where}: is no result of rebar-bench: {type(error).__name__}: {error}") from None


def _table(found: Mapping[str, Any]) -> Table:
    return Table(
        views=found["views"],
        views_scored=found["views_scored"],
        coverage=found["coverage"],
        ranked=found["ranked"],
        native=_metrics(found["native"]),
        scaled=_metrics(found["scaled"]),
        scale_median=found["scale_median"],
        within_mm={int(tolerance): share for tolerance, share in found["within_mm"].items()},
        intervals={name: _interval(found.get("ci95", {}), name) for name in VIEW_NUMBERS},
    )


def _metrics(found: Mapping[str, float | None]) -> DepthMetrics | None:
    numbers = {name: value for name, value in found.items() if value is not None}
    return DepthMetrics(**numbers) if len(numbers) == len(found) else None


def _interval(nested: Mapping[str, Any], name: str) -> tuple[float, float] | None:
    group, _, key = name.rpartition(".")
    ends = (nested.get(group, {}) if group else nested).get(key)
    return None if ends is None else (ends[0], ends[1])
