"""Results as pandas data frames and as CSV, with the rounded numbers of their JSON.

pandas takes half a second to import, which commands without CSV output do not need, so functions import it on use.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rebar_depth_bench.base.errors import printable
from rebar_depth_bench.base.names import config_of
from rebar_depth_bench.scoring.columns import (
    FLAT_VIEWS,
    RELATIVE_INTERVALS,
    RELATIVE_TABLE_COLUMNS,
    TABLE_COLUMNS,
    VIEW_COLUMNS,
    rounded,
    rounded_interval,
)
from rebar_depth_bench.scoring.relative import kind_blocks

if TYPE_CHECKING:
    from pandas import DataFrame

    from rebar_depth_bench.scoring.result import Result
    from rebar_depth_bench.scoring.table import Table

_MAX_TEXT_CHARACTERS = 10_000
_FORMULA_STARTS = ("=", "+", "-", "@")
_DECLARED_COLUMNS = ("protocol", "method", "inputs", "uses_ground_truth")
_METRIC_COLUMNS = (TABLE_COLUMNS, VIEW_COLUMNS)
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

    The 95 % interval of a metric is in the columns ``<metric>_low`` and ``<metric>_high``. Results that are not
    metric have the column ``prediction``; numbers that only other kinds have are undefined. The rows are in the
    order of ``kind_blocks``.
    """
    return _frame(
        results, ("config",), lambda result: [((config,), table) for config, table in result.tables.items()]
    )


def groups_frame(results: Sequence[Result]) -> DataFrame:
    """Return one row per result, config, grouping and group as ``tables_frame``; others have none."""
    return _frame(
        results,
        ("config", "split", "grouping", "group"),
        lambda result: [
            ((config, table.split, grouping, group), of_group)
            for config, table in result.tables.items()
            for grouping, tables in table.groups.items()
            for group, of_group in tables.items()
        ],
    )


def _frame(
    results: Sequence[Result],
    names: Sequence[str],
    tables_of: Callable[[Result], Iterable[tuple[Sequence[Any], Table]]],
) -> DataFrame:
    """Return one row per table of the results; ``tables_of`` returns these and their ``names``."""
    import pandas as pd

    frames = []
    for block in kind_blocks(results) or [[]]:
        kind = [result.prediction for result in block[:1] if result.prediction is not None]
        columns, with_interval = (RELATIVE_TABLE_COLUMNS, RELATIVE_INTERVALS) if kind else _METRIC_COLUMNS
        head = (
            *(*_DECLARED_COLUMNS, *(["prediction"] if kind else []), *names),
            *(column.name for column in columns),
            *(f"{column.name}_{end}" for column in with_interval for end in ("low", "high")),
            *("dataset_digest", "dataset_version", "submission_sha256", "software_version"),
        )
        rows = []
        for result in block:
            submission, dataset = result.submission, result.dataset
            declared = (result.protocol, submission.method, submission.inputs, submission.uses_ground_truth)
            provenance = (dataset.digest, dataset.version, submission.sha256, result.software.version)
            for named, table in tables_of(result):
                ends = (rounded_interval(table.intervals.get(one.path)) or (None, None) for one in with_interval)
                numbers = (*(column.value(table) for column in columns), *(end for both in ends for end in both))
                rows.append((*declared, *kind, *named, *numbers, *provenance))
        frames.append(frame_of_values(head, rows))
    if len(frames) == 1:
        return frames[0]
    joined = pd.concat(frames, ignore_index=True)
    return joined.astype({"flat_views": "Int64"})


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
