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
from rebar_depth_bench.scoring.columns import (
    FLAT_VIEWS,
    RELATIVE_INTERVALS,
    RELATIVE_TABLE_COLUMNS,
    TABLE_COLUMNS,
    VIEW_COLUMNS,
    Column,
    rounded,
    rounded_interval,
)
from rebar_depth_bench.submission.declaration import PREDICTION_KINDS

if TYPE_CHECKING:
    from pandas import DataFrame

    from rebar_depth_bench.scoring.result import Result
    from rebar_depth_bench.scoring.table import Table

_MAX_TEXT_CHARACTERS = 10_000
_FORMULA_STARTS = ("=", "+", "-", "@")
_DECLARED_COLUMNS = ("protocol", "method", "inputs", "uses_ground_truth")
_PROVENANCE_COLUMNS = ("dataset_digest", "dataset_version", "submission_sha256", "software_version")
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

    The 95 % interval of a metric is in the columns ``<metric>_low`` and ``<metric>_high``. With results that are
    not metric there is the column ``prediction``, and the numbers that only other kinds have are NaN; their rows
    are last, by kind, config and aligned error.
    """
    tables = [(result, config, table) for result in results for config, table in result.tables.items()]
    configs = list(dict.fromkeys(config for _, config, _ in tables))

    def order(one: tuple[Result, str, Table]) -> tuple[int, int, float]:
        result, config, table = one
        if result.prediction is None:
            return 0, 0, 0.0
        return PREDICTION_KINDS.index(result.prediction), configs.index(config), table.error or 0.0

    rows = [_table_row(result, table, {"config": config}) for result, config, table in sorted(tables, key=order)]
    return _frame_of_tables(results, ("config",), rows)


def groups_frame(results: Sequence[Result]) -> DataFrame:
    """Return one row per result, config, grouping and group as ``tables_frame``; others have none."""
    rows = [
        _table_row(
            result, of_group, {"config": config, "split": table.split, "grouping": grouping, "group": group}
        )
        for result in results
        for config, table in result.tables.items()
        for grouping, tables in table.groups.items()
        for group, of_group in tables.items()
    ]
    return _frame_of_tables(results, ("config", "split", "grouping", "group"), rows)


def _columns(result: Result) -> tuple[Sequence[Column], Sequence[Column]]:
    """Return the columns of the tables of a result, and those that have intervals."""
    is_metric = result.prediction is None
    return (TABLE_COLUMNS, VIEW_COLUMNS) if is_metric else (RELATIVE_TABLE_COLUMNS, RELATIVE_INTERVALS)


def _frame_of_tables(
    results: Sequence[Result], names: Sequence[str], rows: Sequence[Mapping[str, Any]]
) -> DataFrame:
    """Return rows of numbers by column, or column and end, as a frame with all columns of the results' kinds."""
    kinds = [_columns(result) for result in results] or [(TABLE_COLUMNS, VIEW_COLUMNS)]
    prediction = [] if all(result.prediction is None for result in results) else ["prediction"]
    columns = (
        *(*_DECLARED_COLUMNS, *prediction, *names),
        *dict.fromkeys(column.name for numbers, _ in kinds for column in numbers),
        *dict.fromkeys(f"{column.name}_{end}" for _, of in kinds for column in of for end in ("low", "high")),
        *_PROVENANCE_COLUMNS,
    )
    return frame_of_values(columns, [[row.get(name) for name in columns] for row in rows])


def _table_row(result: Result, table: Table, names: Mapping[str, Any]) -> dict[str, Any]:
    submission, (columns, with_interval) = result.submission, _columns(result)
    row = {
        "protocol": result.protocol,
        "method": submission.method,
        "inputs": submission.inputs,
        "uses_ground_truth": submission.uses_ground_truth,
        "prediction": result.kind,
        **names,
        **{column.name: column.value(table) for column in columns},
        "dataset_digest": result.dataset.digest,
        "dataset_version": result.dataset.version,
        "submission_sha256": submission.sha256,
        "software_version": result.software.version,
    }
    for column in with_interval:
        ends = rounded_interval(table.intervals.get(column.path)) or (None, None)
        row[f"{column.name}_low"], row[f"{column.name}_high"] = ends
    return row


def views_frame(result: Result) -> DataFrame:
    """Return one row per view; undefined metrics are NaN."""
    columns = result.columns if result.prediction is None else (*result.columns, FLAT_VIEWS)
    by_name = {column.of_view or column.name: column for column in columns}
    names = list(by_name)
    if "scale" in by_name:
        names.insert(2, names.pop(names.index("scale")))
    rows = [
        (
            config_of(view.view_id),
            view.view_id,
            view.scored_px,
            *(by_name[name].view_value(view) for name in names),
        )
        for view in result.views
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
