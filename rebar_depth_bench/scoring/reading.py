"""Strict reading of results from JSON that others wrote: all problems at once, each with its place.

Unknown keys are ignored, because results of later versions have more of them.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, TypeVar

from pydantic import Field, Strict, TypeAdapter

from rebar_depth_bench.base.errors import InputError, Problem
from rebar_depth_bench.base.limits import JSON_BYTES
from rebar_depth_bench.base.names import SPLITS, config_of
from rebar_depth_bench.base.reading import parse_json
from rebar_depth_bench.base.validation import format_location, one_of, short_repr, validate_document
from rebar_depth_bench.scoring.bootstrap import Interval
from rebar_depth_bench.scoring.columns import (
    REFERENCES,
    RELATIVE_ALIGNMENTS,
    Column,
    at_place,
    interval_columns,
    table_columns,
    view_columns,
)
from rebar_depth_bench.scoring.protocol import PROTOCOL, RELATIVE_PROTOCOL
from rebar_depth_bench.scoring.relative import ALIGNMENT_BY_KIND
from rebar_depth_bench.scoring.result import (
    DatasetIdentity,
    IntervalMethod,
    Result,
    SoftwareIdentity,
    SubmissionIdentity,
)
from rebar_depth_bench.scoring.table import Frame, Name, PublishedMatch, Table, ViewScore
from rebar_depth_bench.submission.declaration import METRIC

_NAME_CHARACTERS = 300
_NAME = f"text on one line, 1 to {_NAME_CHARACTERS} characters"
_MAX_ENTRIES = 5000
"""Largest number of entries of a JSON object whose keys are names, and of all tables of groups."""
_MAX_PROBLEMS = 100
"""Number of problems after which reading ends, so that a file of many takes no minutes."""


_Count = Annotated[int, Strict(), Field(ge=0, lt=1 << 53)]
_MISSING: Any = object()


@dataclass(frozen=True)
class _Head:
    """What stands in a result beside its tables and views."""

    protocol: Annotated[str, Strict(), one_of(PROTOCOL, RELATIVE_PROTOCOL)]
    dataset: DatasetIdentity
    submission: SubmissionIdentity
    software: SoftwareIdentity
    prediction: Annotated[str, Strict(), one_of(*ALIGNMENT_BY_KIND)] | None = None
    declared_prediction: Annotated[str, Strict(), one_of(METRIC)] | None = None
    intervals: IntervalMethod | None = None


@dataclass(frozen=True)
class _TableHead:
    """What stands in a table beside its numbers, intervals and groups."""

    views: _Count
    views_scored: _Count
    ranked: Annotated[bool, Strict()]
    of_views: _Count | None = None
    split: Annotated[str, Strict(), one_of(*SPLITS)] | None = None
    views_per_distance: Annotated[int, Strict(), Field(ge=1, lt=1 << 53)] | None = None
    truth_sigma_m: Annotated[float, Strict(), Field(ge=0)] | None = None
    published: PublishedMatch | None = None


@dataclass(frozen=True)
class _ViewHead:
    """What stands in a view beside its numbers."""

    view_id: Name
    scored_px: _Count


_Type = TypeVar("_Type")


@cache
def _type_of(head: type[_Type]) -> TypeAdapter[_Type]:
    return TypeAdapter(head)


def read_result(data: bytes, where: str) -> Result:
    """Return the result in ``data`` without extended measures; ``where`` names the source in error messages.

    Raises ``InputError`` with all problems if ``data`` is not a result of ``PROTOCOL``.
    """
    if len(data) > JSON_BYTES.value():
        problem = Problem("size", "", f"the result has {len(data)} bytes", JSON_BYTES.allowed())
        raise InputError.from_problems(where, [problem])
    document, problems = parse_json(data)
    head = None if problems else validate_document(_type_of(_Head), document, problems)
    if head is None:
        raise InputError.from_problems(f"{where}: is not a rebar-bench result", problems)
    kind = head.prediction or METRIC
    if (head.protocol == RELATIVE_PROTOCOL) != (head.prediction is not None):
        found = f"the protocol is {head.protocol} and prediction is {head.prediction}"
        problems.append(Problem("conflict", "", found, f"{RELATIVE_PROTOCOL} for predictions that are not metric"))
    if head.declared_prediction and head.prediction is None:
        missing = "declared_prediction without prediction"
        problems.append(Problem("missing", "", missing, "the kind that was scored"))
    entries = _named_entries(document.get("tables"), "tables", problems)
    if (count := sum(_group_tables(entry) for _, entry in entries)) > _MAX_ENTRIES:
        problems.append(Problem("size", "tables", f"got {count} tables of groups", f"at most {_MAX_ENTRIES}"))
        entries = []
    tables: dict[str, Table] = {}
    for name, entry in entries:
        table = _table_from_json(entry, kind, format_location("tables", name), problems)
        if table is not None:
            tables[name] = table
        if len(problems) > _MAX_PROBLEMS:
            break
    views = document.get("views")
    if not isinstance(views, list):
        problems.append(Problem("invalid", "views", f"got {short_repr(views)}", "a list"))
        views = []
    rows: dict[str, dict[str, Mapping[str, float]]] = {name: {} for name in tables}
    for number, entry in enumerate(views, 1):
        view = _view_from_json(entry, kind, f"views {number}:", problems)
        if view is None:
            break  # A list of views with one mistake has it in all of them.
        if not problems and config_of(view.view_id) not in rows:
            found = "views: a view belongs to no config of the tables"
            problems.append(Problem("conflict", "", found, "views of these"))
            break
        of_config = rows.setdefault(config_of(view.view_id), {})
        if view.view_id in of_config:
            problems.append(Problem("duplicate", "", "views: a view_id occurs twice", "each view once"))
            break
        of_config[view.view_id] = view.numbers
    if problems:
        raise InputError.from_problems(f"{where}: is not a rebar-bench result", problems)
    frames = {name: Frame.of_rows(of_config) for name, of_config in rows.items()}
    return Result(**vars(head), tables=tables, frames=frames)


def _group_tables(table: object) -> int:
    """Return the number of groupings and groups of a table that has not been checked."""
    groups = table.get("groups") if isinstance(table, dict) else None
    if not isinstance(groups, dict):
        return 0
    return len(groups) + sum(len(of_grouping) for of_grouping in groups.values() if isinstance(of_grouping, dict))


def read_table(document: Mapping[str, Any]) -> Table:
    """Return the table of a config of metric predictions from its JSON object, without groups.

    Raises ``InputError`` if it is invalid.
    """
    problems: list[Problem] = []
    table = _table_from_json({**document, "groups": {}}, METRIC, "", problems)
    if table is None or problems:
        raise InputError.from_problems("the table of a result", problems)
    return table


def _table_from_json(
    entry: Any, kind: str, where: str, problems: list[Problem], *, is_group: bool = False
) -> Table | None:
    """Return a table from its JSON object; None, with all of its problems appended, if it is invalid.

    A table that ``is_group`` has no groups, whatever the object holds.
    """
    before = len(problems)
    head = validate_document(_type_of(_TableHead), entry, problems, where)
    if head is None:
        return None
    if head.views == 0:
        kind = METRIC  # Without views there is nothing of any kind, and the table is written as a metric one.
    columns = (*table_columns(kind), *REFERENCES)
    numbers = _numbers_from_json(
        entry, kind, {column.place: column for column in columns}, where, problems, is_empty=head.views == 0
    )
    intervals = _intervals_from_json(entry.get("ci95", {}), kind, format_location(where, "ci95"), problems)
    groups: dict[str, dict[str, Table]] = {}
    place = format_location(where, "groups")
    for grouping, tables in () if is_group else _named_entries(entry.get("groups", {}), place, problems):
        inner = format_location(place, grouping)
        groups[grouping] = {}
        for group, document in _named_entries(tables, inner, problems):
            table = _table_from_json(document, kind, format_location(inner, group), problems, is_group=True)
            if table is not None:
                groups[grouping][group] = table
    if len(problems) > before:
        return None
    is_ranked = head.ranked and not math.isnan(numbers.get("rank_error", math.nan))
    known = {**vars(head), "ranked": is_ranked, "numbers": numbers, "intervals": intervals, "groups": groups}
    return Table(kind=kind, **known)


def _view_from_json(entry: Any, kind: str, where: str, problems: list[Problem]) -> ViewScore | None:
    """Return a view from its JSON object; None, with all of its problems appended, if it is invalid."""
    before = len(problems)
    head = validate_document(_type_of(_ViewHead), entry, problems, where)
    if head is None:
        return None
    columns = {column.place_in_view: column for column in view_columns(kind)}
    numbers = _numbers_from_json(entry, kind, columns, where, problems, never_null=["coverage"])
    return None if len(problems) > before else ViewScore(head.view_id, {"scored_px": head.scored_px, **numbers})


def _named_entries(found: Any, where: str, problems: list[Problem]) -> list[tuple[str, Any]]:
    """Return the entries of a JSON object whose keys are names; invalid ones are appended to the problems."""
    if not isinstance(found, dict):
        problems.append(Problem("invalid", where, f"got {short_repr(found)}", "a table"))
        return []
    if len(found) > _MAX_ENTRIES:
        problems.append(Problem("size", where, f"got {len(found)} entries", f"at most {_MAX_ENTRIES}"))
        return []
    problems += [
        Problem("invalid", format_location(where, name), "the key is no name", _NAME)
        for name in found
        if not _is_name(name)
    ]
    return list(found.items())


def _is_name(value: Any) -> bool:
    """Return whether a value is printable text of at most ``_NAME_CHARACTERS``."""
    return (
        isinstance(value, str) and len(value) <= _NAME_CHARACTERS and value.isprintable() and bool(value.strip())
    )


def _is_finite(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) <= sys.float_info.max


def _is_size(value: Any) -> bool:
    return _is_finite(value) and bool(value >= 0)


def _numbers_from_json(
    entry: Mapping[str, Any],
    kind: str,
    columns: Mapping[str, Column],
    where: str,
    problems: list[Problem],
    *,
    is_empty: bool = False,
    never_null: Sequence[str] = (),
) -> dict[str, float]:
    """Return the numbers of a table or view; ``columns`` has the column of each place.

    Null is an undefined number, but inf among the errors of valid predictions; it is refused at ``never_null`` and
    for errors over all pixels. A table that ``is_empty`` has no views, and no errors of any kind.
    """
    errors = ("rank_error", *RELATIVE_ALIGNMENTS)
    expected = {METRIC: errors[:1], "scale": ("aligned", "constant")}.get(kind, RELATIVE_ALIGNMENTS)
    found = tuple(name for name in errors if entry.get(name) is not None)
    if found != expected and not is_empty:
        text = f"a table or view has {', '.join(found) or 'no errors'}"
        problems.append(Problem("conflict", where.removesuffix(":"), text, ", ".join(expected)))
        return {}
    is_predicted = entry.get("views_scored", entry.get("coverage")) not in (0, None)
    by_group: dict[str, list[tuple[str, Column]]] = {}
    for place, column in columns.items():
        by_group.setdefault(place.rpartition(".")[0], []).append((place, column))
    numbers: dict[str, float] = {}
    for group, members in by_group.items():
        inner = at_place(entry, group) if group else entry
        at = format_location(where, *group.split(".")) if group else where
        is_metric_error = group in ("native", "scaled")
        is_error = is_metric_error or group in RELATIVE_ALIGNMENTS
        may_be_null = (
            is_empty or group.startswith(("aligned_robust", "reference")) or (is_error and not is_predicted)
        )
        if inner is None and may_be_null:
            numbers |= {place: math.nan for place, _ in members}
        elif inner is None and is_error:
            found_null, wanted = f"{group} is null", "metrics where there is a prediction"
            problems.append(Problem("conflict", where.removesuffix(":"), found_null, wanted))
        elif not isinstance(inner, dict):
            problems.append(Problem("invalid", at, f"got {short_repr(inner)}", "a table"))
        elif len(inner) > _MAX_ENTRIES:
            problems.append(Problem("size", at, f"got {len(inner)} entries", f"at most {_MAX_ENTRIES}"))
        else:
            for place, column in members:
                key = place.rpartition(".")[2]
                is_flag = column.statistic == "count" and column.place_in_view == place
                is_whole = column.statistic == "count" and not is_flag
                most = f"from 0 to {column.most:g}" if math.isfinite(column.most) else "of 0 or more"
                wanted = "true or false" if is_flag else f"a {'whole ' * is_whole}number {most}"
                # Other numbers at the top level may be of a later version, and references of one, too.
                is_needed = place in ("coverage", "rank_error") or (group and not group.startswith("reference"))
                value: Any = inner.get(key, _MISSING if is_needed else None)
                if value is None and key != "error" and place not in never_null:
                    numbers[place] = math.inf if is_error and is_predicted else math.nan
                elif value is _MISSING:
                    problems.append(Problem("missing", format_location(at, key), "missing", wanted))
                elif (
                    isinstance(value, bool)
                    if is_flag
                    else _is_size(value) and value <= column.most and (isinstance(value, int) or not is_whole)
                ):
                    numbers[place] = float(value) if is_predicted or not is_metric_error else math.nan
                else:
                    got = f"got {short_repr(value)}"
                    problems.append(Problem("invalid", format_location(at, key), got, wanted))
    return numbers


def _intervals_from_json(entry: Any, kind: str, where: str, problems: list[Problem]) -> dict[str, Interval | None]:
    """Return the interval of each column that has one; a missing one is undefined."""
    intervals: dict[str, Interval | None] = {}
    for column in interval_columns(kind):
        group = column.place.rpartition(".")[0]
        inner = at_place(entry, group) if group else entry
        ends = at_place(entry, column.place)
        intervals[column.place] = None
        if inner is not None and not isinstance(inner, dict):
            problem = Problem(
                "invalid", format_location(where, *filter(None, [group])), f"got {short_repr(inner)}", "a table"
            )
            if problem not in problems:
                problems.append(problem)
        elif isinstance(ends, list) and len(ends) == 2 and all(end is None or _is_finite(end) for end in ends):
            if None not in ends:
                intervals[column.place] = float(ends[0]), float(ends[1])
        elif ends is not None:
            place = format_location(where, *column.place.split("."))
            problems.append(Problem("invalid", place, f"got {short_repr(ends)}", "two numbers, or null"))
    return intervals
