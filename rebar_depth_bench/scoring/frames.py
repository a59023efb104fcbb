"""Results as pandas data frames, with the rounded numbers of their JSON.

pandas takes half a second to import, which commands without CSV output do not need, so functions import it on use.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rebar_depth_bench.names import config_of
from rebar_depth_bench.scoring.metrics import METRIC_NAMES
from rebar_depth_bench.scoring.protocol import WITHIN_MM
from rebar_depth_bench.scoring.rounding import rounded

if TYPE_CHECKING:
    from pandas import DataFrame

ALIGNMENTS = ("native", "scaled")
METRIC_COLUMNS: Mapping[str, str] = {
    "coverage": "coverage",
    "rank_error": "rank_error",
    **{f"{alignment}.{name}": f"{alignment}_{name}" for alignment in ALIGNMENTS for name in METRIC_NAMES},
    "scale_median": "scale_median",
    **{f"within_mm.{tolerance}": f"within_{tolerance}mm" for tolerance in WITHIN_MM},
}
"""Column names of the metrics with an interval, by their names in ``VIEW_METRICS``."""

_REFERENCES, _REFERENCE_ERRORS = ("constant", "one_pixel", "scaled_constant"), ("abs_rel", "rmse_cm")
REFERENCE_COLUMNS = tuple(f"{reference}_{name}" for reference in _REFERENCES for name in _REFERENCE_ERRORS)
"""Column names of the reference errors of a config."""

TABLE_COLUMNS = (
    *("views", "views_scored", "coverage", "ranked"),
    *(column for column in METRIC_COLUMNS.values() if column != "coverage"),
    *REFERENCE_COLUMNS,
)
"""Column names of the numbers of a config's table, without intervals."""

_DECLARED_COLUMNS = ("protocol", "method", "inputs", "uses_ground_truth")
_NUMBER_COLUMNS = (
    *TABLE_COLUMNS,
    *(f"{column}_{end}" for column in METRIC_COLUMNS.values() for end in ("low", "high")),
    *("dataset_digest", "dataset_version", "submission_sha256", "software_version"),
)
_TABLE_FRAME_COLUMNS = (*_DECLARED_COLUMNS, "config", *_NUMBER_COLUMNS)
_GROUP_FRAME_COLUMNS = (*_DECLARED_COLUMNS, "config", "split", "grouping", "group", *_NUMBER_COLUMNS)
_DIFFERENCE_COLUMNS = (
    *("first_method", "other_method", "config", "number", "views", "first", "other", "difference", "low", "high"),
    *("verdict", "protocol", "dataset_digest", "software_version", "first_sha256", "other_sha256"),
)


def table_values(table: Mapping[str, Any]) -> list[Any]:
    """Return a config's numbers in the order of ``TABLE_COLUMNS``, from its table in the result's JSON.

    ``scaled_constant`` is missing in results that a leaderboard keeps from an earlier version.
    """
    reference = table["reference"]
    return [
        *(table[key] for key in ("views", "views_scored", "coverage", "ranked", "rank_error")),
        *(table[alignment][name] for alignment in ALIGNMENTS for name in METRIC_NAMES),
        table["scale_median"],
        *(table["within_mm"][str(tolerance)] for tolerance in WITHIN_MM),
        *(reference.get(name, {}).get(error) for name in _REFERENCES for error in _REFERENCE_ERRORS),
    ]


def make_frame(rows: Sequence[Mapping[str, Any]]) -> DataFrame:
    """Return rows with equal keys as the frame of ``frame_of_values``; without rows it has no columns."""
    names = list(rows[0]) if rows else []
    return frame_of_values(names, [[row[name] for name in names] for row in rows])


def frame_of_values(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> DataFrame:
    """Return rows of one value per column as a frame, which has the columns even if there are no rows.

    Floats are rounded as in the JSON. Undefined numbers are NaN, or <NA> among integers, which stay integers.
    """
    import pandas as pd

    by_column = list(zip(*rows, strict=True)) or [()] * len(columns)
    values = {name: [_rounded(value) for value in column] for name, column in zip(columns, by_column, strict=True)}
    frame = pd.DataFrame(values, columns=list(columns))
    for name, column in values.items():
        defined = [value for value in column if value is not None]
        if defined and len(defined) < len(rows) and all(type(value) is int for value in defined):
            frame[name] = frame[name].astype("Int64")
    return frame


def tables_frame(documents: Sequence[Mapping[str, Any]]) -> DataFrame:
    """Return one row per result and config, with provenance, from the JSON objects of results.

    The 95 % interval of a metric is in the columns ``<metric>_low`` and ``<metric>_high``.
    """
    rows = [
        _table_row(document, table, (config,))
        for document in documents
        for config, table in document["tables"].items()
    ]
    return frame_of_values(_TABLE_FRAME_COLUMNS, rows)


def groups_frame(documents: Sequence[Mapping[str, Any]]) -> DataFrame:
    """Return one row per result, config, grouping and group as ``tables_frame``; others have none."""
    rows = [
        _table_row(document, group_table, (config, table.get("split"), grouping, group))
        for document in documents
        for config, table in document["tables"].items()
        for grouping, tables in table.get("groups", {}).items()
        for group, group_table in tables.items()
    ]
    return frame_of_values(_GROUP_FRAME_COLUMNS, rows)


def _table_row(document: Mapping[str, Any], table: Mapping[str, Any], names: Sequence[Any]) -> tuple[Any, ...]:
    return (
        document["protocol"],
        *(document["submission"][key] for key in ("method", "inputs", "uses_ground_truth")),
        *names,
        *table_values(table),
        *_interval_bounds(table["ci95"]),
        *(document["dataset"]["digest"], document["dataset"]["version"]),
        *(document["submission"]["sha256"], document["software"]["version"]),
    )


def views_frame(document: Mapping[str, Any]) -> DataFrame:
    """Return one row per view from the JSON object of a result; undefined metrics are NaN."""
    rows = [
        {
            "config": config_of(view["view_id"]),
            **{key: view[key] for key in ("view_id", "scored_px", "coverage", "rank_error", "scale")},
            **{f"{alignment}_{name}": view[alignment][name] for alignment in ALIGNMENTS for name in METRIC_NAMES},
            **{f"within_{tolerance}mm": view["within_mm"][str(tolerance)] for tolerance in WITHIN_MM},
        }
        for view in document["views"]
    ]
    return make_frame(rows)


def differences_frame(documents: Sequence[Mapping[str, Any]]) -> DataFrame:
    """Return one row per comparison, config and metric from the JSON objects of comparisons."""
    rows: list[tuple[Any, ...]] = []
    for document in documents:
        first, other = document["submissions"]
        for config, differences in document["configs"].items():
            rows += [
                (
                    *(first["method"], other["method"], config, difference["name"]),
                    *(difference[key] for key in ("views", "first", "other", "difference")),
                    *(difference["ci95"] or (None, None)),
                    *(difference["verdict"], document["protocol"], document["dataset"]["digest"]),
                    *(document["software"]["version"], first["sha256"], other["sha256"]),
                )
                for difference in differences
            ]
    return frame_of_values(_DIFFERENCE_COLUMNS, rows)


def _interval_bounds(intervals: Mapping[str, Any]) -> Iterator[float | None]:
    for name in METRIC_COLUMNS:
        group, _, key = name.rpartition(".")
        yield from (intervals[group] if group else intervals)[key] or (None, None)


def _rounded(value: Any) -> Any:
    return rounded(value) if isinstance(value, float) else value
