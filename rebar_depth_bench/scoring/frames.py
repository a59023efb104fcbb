"""Results as pandas data frames, with the rounded numbers of their JSON.

pandas takes half a second to import, which commands without CSV output do not need, so functions import it on use.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rebar_depth_bench.scoring.metrics import METRIC_NAMES
from rebar_depth_bench.scoring.protocol import WITHIN_MM
from rebar_depth_bench.scoring.rounding import rounded
from rebar_depth_bench.submission import config_of

if TYPE_CHECKING:
    from pandas import DataFrame

ALIGNMENTS = ("native", "scaled")
METRIC_COLUMNS: Mapping[str, str] = {
    "coverage": "coverage",
    **{f"{alignment}.{name}": f"{alignment}_{name}" for alignment in ALIGNMENTS for name in METRIC_NAMES},
    "scale_median": "scale_median",
    **{f"within_mm.{tolerance}": f"within_{tolerance}mm" for tolerance in WITHIN_MM},
}
"""Column names of the metrics with an interval, by their names in ``VIEW_METRICS``."""

TABLE_COLUMNS = (
    *("views", "views_scored", "coverage", "ranked"),
    *(column for column in METRIC_COLUMNS.values() if column != "coverage"),
)
"""Column names of the numbers of a config's table, without intervals."""


def table_values(table: Mapping[str, Any]) -> list[Any]:
    """Return a config's numbers in the order of ``TABLE_COLUMNS``, from its table in the result's JSON."""
    return [
        *(table[key] for key in ("views", "views_scored", "coverage", "ranked")),
        *table["native"].values(),
        *table["scaled"].values(),
        table["scale_median"],
        *table["within_mm"].values(),
    ]


def make_frame(rows: Sequence[Mapping[str, Any]], columns: Sequence[str] = ()) -> DataFrame:
    """Return rows with equal keys as a frame; ``columns`` names the columns if there may be no rows.

    Floats are rounded as in the JSON. Undefined numbers are NaN, or <NA> among integers, which stay integers.
    """
    import pandas as pd

    names = list(rows[0]) if rows else list(columns)
    frame = pd.DataFrame({name: [_rounded(row[name]) for row in rows] for name in names}, columns=names)
    for name in names:
        values = [row[name] for row in rows if row[name] is not None]
        if values and len(values) < len(rows) and all(type(value) is int for value in values):
            frame[name] = frame[name].astype("Int64")
    return frame


def tables_frame(documents: Sequence[Mapping[str, Any]]) -> DataFrame:
    """Return one row per result and config, with provenance, from the JSON objects of results.

    The 95 % interval of a metric is in the columns ``<metric>_low`` and ``<metric>_high``.
    """
    rows = [
        {
            "protocol": document["protocol"],
            "method": document["submission"]["method"],
            "config": config,
            **dict(zip(TABLE_COLUMNS, table_values(table), strict=True)),
            **_interval_columns(table["ci95"]),
            "dataset_digest": document["dataset"]["digest"],
            "dataset_version": document["dataset"]["version"],
            "submission_sha256": document["submission"]["sha256"],
            "software_version": document["software"]["version"],
        }
        for document in documents
        for config, table in document["tables"].items()
    ]
    return make_frame(rows)


def views_frame(document: Mapping[str, Any]) -> DataFrame:
    """Return one row per view from the JSON object of a result; undefined metrics are NaN."""
    rows = [
        {
            "config": config_of(view["view_id"]),
            **{key: view[key] for key in ("view_id", "scored_px", "coverage", "scale")},
            **{f"{alignment}_{name}": view[alignment][name] for alignment in ALIGNMENTS for name in METRIC_NAMES},
            **{f"within_{tolerance}mm": share for tolerance, share in view["within_mm"].items()},
        }
        for view in document["views"]
    ]
    return make_frame(rows)


def differences_frame(documents: Sequence[Mapping[str, Any]]) -> DataFrame:
    """Return one row per comparison, config and metric from the JSON objects of comparisons."""
    rows = []
    for document in documents:
        first, other = document["submissions"]
        for config, differences in document["configs"].items():
            for difference in differences:
                low, high = difference["ci95"] or (None, None)
                rows.append(
                    {
                        "first_method": first["method"],
                        "other_method": other["method"],
                        "config": config,
                        "number": difference["name"],
                        **{key: difference[key] for key in ("views", "first", "other", "difference")},
                        "low": low,
                        "high": high,
                        "verdict": difference["verdict"],
                        "protocol": document["protocol"],
                        "dataset_digest": document["dataset"]["digest"],
                        "software_version": document["software"]["version"],
                        "first_sha256": first["sha256"],
                        "other_sha256": other["sha256"],
                    }
                )
    return make_frame(rows)


def _interval_columns(intervals: Mapping[str, Any]) -> dict[str, float | None]:
    columns: dict[str, float | None] = {}
    for name, column in METRIC_COLUMNS.items():
        group, _, key = name.rpartition(".")
        bounds = (intervals[group] if group else intervals)[key] or (None, None)
        columns[f"{column}_low"], columns[f"{column}_high"] = bounds
    return columns


def _rounded(value: Any) -> Any:
    return rounded(value) if isinstance(value, float) else value
