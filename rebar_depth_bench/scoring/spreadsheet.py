"""Numbers as rows for spreadsheets: CSV and pandas data frames, with the rounded numbers of the JSON.

pandas takes half a second to import, which commands do not need: only ``Sheet.to_pandas`` imports it.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from rebar_depth_bench.base.errors import printable
from rebar_depth_bench.scoring.columns import (
    COVERAGE,
    FLAT_VIEWS,
    METRIC_COLUMNS,
    REFERENCES,
    RELATIVE_COLUMNS,
    at_place,
    interval_columns,
    rounded,
    view_columns,
)
from rebar_depth_bench.scoring.formatting import kind_blocks
from rebar_depth_bench.submission.declaration import METRIC

if TYPE_CHECKING:
    from pandas import DataFrame

    from rebar_depth_bench.scoring.result import Result
    from rebar_depth_bench.scoring.table import Table

_MAX_TEXT_CHARACTERS = 10_000
_FORMULA_STARTS = ("=", "+", "-", "@")
_DIFFERENCE_HEADS = (
    *("first_method", "other_method", "config", "number", "views", "first", "other", "difference", "low", "high"),
    *("verdict", "protocol", "dataset_digest", "software_version", "first_sha256", "other_sha256"),
)


@dataclass(frozen=True)
class Sheet:
    """Rows of values below their heads; None is an undefined value. Floats are rounded as in the JSON."""

    heads: Sequence[str]
    rows: Sequence[Sequence[Any]]

    @property
    def values(self) -> list[list[Any]]:
        """Rows with rounded floats."""
        return [[rounded(value) if isinstance(value, float) else value for value in row] for row in self.rows]

    def to_csv(self) -> str:
        r"""Return the sheet as CSV with ``\n`` line ends; undefined numbers are empty.

        Text that a spreadsheet would execute as a formula gets a leading apostrophe, and control characters become
        U+FFFD.
        """
        return csv_text([self.heads, *self.values])

    def to_pandas(self) -> DataFrame:
        """Return the sheet as a frame, which has its columns even if there are no rows.

        Undefined numbers are NaN, or <NA> among integers, which stay integers.
        """
        import pandas as pd

        by_head = list(zip(*self.values, strict=True)) or [()] * len(self.heads)
        frame = pd.DataFrame(dict(zip(self.heads, map(list, by_head), strict=True)), columns=list(self.heads))
        for head, column in zip(self.heads, by_head, strict=True):
            defined = [value for value in column if value is not None]
            if defined and len(defined) < len(column) and all(type(value) is int for value in defined):
                frame[head] = frame[head].astype("Int64")
            if column and not defined and isinstance(self.rows[0][self.heads.index(head)], float):
                frame[head] = np.nan
        return frame


def csv_text(rows: Iterable[Iterable[str | float | bool | None]]) -> str:
    r"""Return rows of values, the first of which is the header, as CSV; see ``Sheet.to_csv``."""
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


def table_places(kind: str) -> dict[str, str]:
    """Return the place of each number of a table in its JSON, by the name of its column."""
    flat = [] if kind == METRIC else [FLAT_VIEWS]
    columns = (*METRIC_COLUMNS, *REFERENCES) if kind == METRIC else RELATIVE_COLUMNS
    numbers = {column.name: column.place for column in (*flat, COVERAGE, *columns)}
    ranked = list(numbers).index(COVERAGE.name) + 1
    names = ["views", "views_scored", *list(numbers)[:ranked], "ranked", *list(numbers)[ranked:]]
    return {name: numbers.get(name, name) for name in names}


def tables_sheet(results: Sequence[Result], *, groups: bool = False) -> Sheet:
    """Return one row per result and config, or with ``groups`` per group of views of it, with provenance.

    The 95 % interval of a metric is in the columns ``<metric>_low`` and ``<metric>_high``. Results that are not
    metric have the column ``prediction``; numbers that only other kinds have are undefined. The rows are in the
    order of ``kind_blocks``.
    """
    heads: dict[str, None] = {}
    rows: list[dict[str, Any]] = []
    for block in kind_blocks(results) or [[]]:
        kind = block[0].kind if block else METRIC
        places, with_interval = table_places(kind), interval_columns(kind)
        named = ("config", "split", "grouping", "group") if groups else ("config",)
        heads |= dict.fromkeys([
            *("protocol", "method", "inputs", "uses_ground_truth"),
            *([] if kind == METRIC else ["prediction"]),
            *named,
            *places,
            *(f"{column.name}_{end}" for column in with_interval for end in ("low", "high")),
            *("dataset_digest", "dataset_version", "submission_sha256", "software_version"),
        ])  # fmt: skip
        for result in block:
            submission, dataset = result.submission, result.dataset
            about: dict[str, Any] = {
                "protocol": result.protocol,
                "method": submission.method,
                "inputs": submission.inputs,
                "uses_ground_truth": submission.uses_ground_truth,
                "prediction": result.prediction,
                "dataset_digest": dataset.digest,
                "dataset_version": dataset.version,
                "submission_sha256": submission.sha256,
                "software_version": result.software.version,
            }
            named_tables: list[tuple[tuple[str | None, ...], Table]]
            named_tables = [((config,), table) for config, table in result.tables.items()]
            if groups:
                named_tables = [
                    ((config, table.split, grouping, group), of_group)
                    for config, table in result.tables.items()
                    for grouping, tables in table.groups.items()
                    for group, of_group in tables.items()
                ]
            for names, table in named_tables:
                document = table.to_dict()
                row = about | dict(zip(named, names, strict=True))
                row |= {name: at_place(document, place) for name, place in places.items()}
                for column in with_interval:
                    low, high = at_place(document["ci95"], column.place) or (None, None)
                    row |= {f"{column.name}_low": low, f"{column.name}_high": high}
                rows.append(row)
    return Sheet(list(heads), [[row.get(head) for head in heads] for row in rows])


def views_sheet(result: Result) -> Sheet:
    """Return one row per view."""
    columns = view_columns(result.kind)
    if result.kind == "scale":
        columns = (*result.columns, FLAT_VIEWS)
    rows = [
        (config, view.view_id, int(view["scored_px"]), *(column.view_json_value(view) for column in columns))
        for config, frame in result.frames.items()
        for view in frame.views()
    ]
    return Sheet(["config", "view_id", "scored_px", *(column.view_name for column in columns)], rows)


def differences_sheet(documents: Sequence[Mapping[str, Any]]) -> Sheet:
    """Return one row per comparison, config and metric from the JSON objects of comparisons."""
    rows = []
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
    return Sheet(_DIFFERENCE_HEADS, rows)
