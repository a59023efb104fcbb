"""Results as pandas data frames and as CSV, with the rounded numbers of their JSON.

pandas takes half a second to import, which commands without CSV output do not need, so functions import it on use.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rebar_depth_bench.base.errors import printable
from rebar_depth_bench.base.names import config_of
from rebar_depth_bench.scoring.columns import TABLE_COLUMNS, VIEW_COLUMNS, rounded, rounded_interval

if TYPE_CHECKING:
    from pandas import DataFrame

    from rebar_depth_bench.scoring.result import Result
    from rebar_depth_bench.scoring.table import Table, ViewScore

_MAX_TEXT_CHARACTERS = 10_000
_FORMULA_STARTS = ("=", "+", "-", "@")
_DECLARED_COLUMNS = ("protocol", "method", "inputs", "uses_ground_truth")
_NUMBER_COLUMNS = (
    *(column.name for column in TABLE_COLUMNS),
    *(f"{column.name}_{end}" for column in VIEW_COLUMNS for end in ("low", "high")),
    *("dataset_digest", "dataset_version", "submission_sha256", "software_version"),
)
_TABLE_FRAME_COLUMNS = (*_DECLARED_COLUMNS, "config", *_NUMBER_COLUMNS)
_GROUP_FRAME_COLUMNS = (*_DECLARED_COLUMNS, "config", "split", "grouping", "group", *_NUMBER_COLUMNS)
_DIFFERENCE_COLUMNS = (
    *("first_method", "other_method", "config", "number", "views", "first", "other", "difference", "low", "high"),
    *("verdict", "protocol", "dataset_digest", "software_version", "first_sha256", "other_sha256"),
)


def frame_of_values(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> DataFrame:
    """Return rows of one value per column as a frame, which has the columns even if there are no rows.

    Floats are rounded as in the JSON. Undefined numbers are NaN, or <NA> among integers, which stay integers.
    """
    import pandas as pd

    by_column = list(zip(*rows, strict=True)) or [()] * len(columns)
    values = {
        name: [rounded(value) if isinstance(value, float) else value for value in column]
        for name, column in zip(columns, by_column, strict=True)
    }
    frame = pd.DataFrame(values, columns=list(columns))
    for name, column in values.items():
        defined = [value for value in column if value is not None]
        if defined and len(defined) < len(rows) and all(type(value) is int for value in defined):
            frame[name] = frame[name].astype("Int64")
    return frame


def tables_frame(results: Sequence[Result]) -> DataFrame:
    """Return one row per result and config, with provenance.

    The 95 % interval of a metric is in the columns ``<metric>_low`` and ``<metric>_high``.
    """
    rows = [_table_row(result, table, (config,)) for result in results for config, table in result.tables.items()]
    return frame_of_values(_TABLE_FRAME_COLUMNS, rows)


def groups_frame(results: Sequence[Result]) -> DataFrame:
    """Return one row per result, config, grouping and group as ``tables_frame``; others have none."""
    rows = [
        _table_row(result, of_group, (config, table.split, grouping, group))
        for result in results
        for config, table in result.tables.items()
        for grouping, tables in table.groups.items()
        for group, of_group in tables.items()
    ]
    return frame_of_values(_GROUP_FRAME_COLUMNS, rows)


def _table_row(result: Result, table: Table, names: Sequence[Any]) -> tuple[Any, ...]:
    ends = (rounded_interval(table.intervals.get(column.path)) or (None, None) for column in VIEW_COLUMNS)
    submission = result.submission
    return (
        *(result.protocol, submission.method, submission.inputs, submission.uses_ground_truth),
        *names,
        *(column.value(table) for column in TABLE_COLUMNS),
        *(end for both in ends for end in both),
        *(result.dataset.digest, result.dataset.version, submission.sha256, result.software.version),
    )


def views_frame(views: Sequence[ViewScore]) -> DataFrame:
    """Return one row per view; undefined metrics are NaN."""
    names = [column.of_view or column.name for column in VIEW_COLUMNS]
    names.insert(2, names.pop(names.index("scale")))
    by_name = {column.of_view or column.name: column for column in VIEW_COLUMNS}
    rows = [
        (
            config_of(view.view_id),
            view.view_id,
            view.scored_px,
            *(by_name[name].view_value(view) for name in names),
        )
        for view in views
    ]
    return frame_of_values(("config", "view_id", "scored_px", *names) if rows else (), rows)


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


def frame_csv(frame: DataFrame) -> str:
    r"""Return a frame as CSV with ``\n`` line ends; undefined numbers are empty.

    Text that a spreadsheet would execute as a formula gets a leading apostrophe, and control characters become
    U+FFFD.
    """
    if frame.columns.empty:
        return ""
    cells = frame.astype(object).where(frame.notna(), None)
    return csv_text([list(frame.columns), *cells.itertuples(index=False, name=None)])


def csv_text(rows: Iterable[Iterable[str | float | bool | None]]) -> str:
    r"""Return rows of values, the first of which is the header, as CSV with ``\n`` line ends."""
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows([_csv_cell(value) for value in row] for row in rows)
    return out.getvalue()


def _csv_cell(value: str | float | bool | None) -> str:
    """Return a value as a CSV cell: empty for None, text without formulas and control characters."""
    if value is None:
        return ""
    if isinstance(value, str):
        clean = printable(value, limit=_MAX_TEXT_CHARACTERS)
        return f"'{clean}" if clean.startswith(_FORMULA_STARTS) else clean
    return json.dumps(value)
