"""Reading of files of detections, CSV or Parquet, with all their problems; nothing is scored if there are any."""

from __future__ import annotations

import csv
import io
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
import pyarrow as pa
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.base.errors import Problem, SubmissionError, escape_text, library_message
from rebar_depth_bench.base.limits import DETECTIONS_BYTES
from rebar_depth_bench.base.names import config_of, split_of
from rebar_depth_bench.base.reading import decode_text, open_regular, parse_number, read_file
from rebar_depth_bench.base.validation import validate_table
from rebar_depth_bench.data.files import file_sha256
from rebar_depth_bench.data.shards import Table, open_parquet
from rebar_depth_bench.submission.declaration import SubmissionMeta

# Columns of a file of detections, and its content as arrays in the order of the file.

VIEW_ID = "view_id"
CAMERA, WORLD = ("x", "y", "z"), ("world_x", "world_y", "world_z")
NORMAL = ("nx", "ny", "nz")
CONFIDENCE = "confidence"
NUMBERS = (*CAMERA, *WORLD, *NORMAL, CONFIDENCE)
"""Columns of numbers; further columns of a file are not read."""

METADATA = ("method", "inputs", "uses_ground_truth")
"""Keys of a file's metadata: of the schema of a Parquet file, or lines ``# key: value`` at the start of a CSV."""

MAX_REPORTED = 1000
"""Number of problems of a file that are kept; a file may have one in every row."""


@dataclass(frozen=True, eq=False)
class RawDetections:
    """Content of a file of detections: ids of views, numbers by column, and metadata as text.

    ``lines`` are the numbers of the rows in messages: lines of a CSV, or rows of a Parquet file, from 1.
    ``faulty`` are the positions of rows whose problems have been reported.
    """

    view_ids: Sequence[str]
    numbers: Mapping[str, Float64[ndarray, " n"]]
    lines: Sequence[int]
    metadata: Mapping[str, str]
    row_noun: str
    faulty: frozenset[int] = frozenset()


@dataclass(frozen=True, eq=False)
class Detections:
    """Detections of crossings, n rows: points in metres in the frame ``is_world`` says, of the view or the world.

    ``normal`` has unit vectors in the same frame, NaN where none is given; ``confidence`` is 1 where none is
    given.
    """

    view_ids: Sequence[str]
    is_world: bool
    point_m: Float64[ndarray, "n 3"]
    normal: Float64[ndarray, "n 3"]
    confidence: Float64[ndarray, " n"]
    has_confidence: bool

    def of(self, rows: Sequence[int]) -> Detections:
        """Return some of the rows."""
        places = np.array(rows, dtype=np.int64)
        return Detections(
            [self.view_ids[row] for row in rows],
            self.is_world,
            self.point_m[places],
            self.normal[places],
            self.confidence[places],
            self.has_confidence,
        )


def column_problems(names: Sequence[str]) -> list[Problem]:
    """Return the problems of the columns of a file."""
    problems = [
        Problem("duplicate", name, "the column occurs more than once", "each column once")
        for name in (VIEW_ID, *NUMBERS)
        if names.count(name) > 1
    ]
    if VIEW_ID not in names:
        problems.append(Problem("missing", VIEW_ID, "the column is missing", "the id of the view of each row"))
    present = [columns for columns in (CAMERA, WORLD) if any(name in names for name in columns)]
    either = "x, y, z (left camera) or world_x, world_y, world_z"
    if len(present) == 2:
        problems.append(Problem("conflict", "", "the file has columns of both frames", either))
    elif not present:
        problems.append(Problem("missing", "", "the file has no columns of positions", either))
    for columns in (*present, *([NORMAL] if any(name in names for name in NORMAL) else [])):
        absent = [name for name in columns if name not in names]
        if absent and len(present) < 2:
            expected = f"all of {', '.join(columns)}"
            problems.append(Problem("missing", absent[0], "the column is missing", expected))
    return problems


def checked_detections(raw: RawDetections, problems: list[Problem]) -> Detections:
    """Return the detections of a file with valid columns; problems of its values are added to ``problems``."""
    is_world = WORLD[0] in raw.numbers
    point_m = np.column_stack([raw.numbers[name] for name in (WORLD if is_world else CAMERA)]).reshape(-1, 3)
    not_finite = np.flatnonzero(~np.isfinite(point_m).all(axis=1))
    problems += _problems(raw, not_finite, "the position is not finite", "three numbers, metres")
    confidence = raw.numbers.get(CONFIDENCE)
    if confidence is not None:
        not_finite = np.flatnonzero(~np.isfinite(confidence))
        problems += _problems(raw, not_finite, "the confidence is not finite", "a number")
    return Detections(
        raw.view_ids,
        is_world,
        point_m,
        _unit_normals(raw, problems),
        np.ones(len(point_m)) if confidence is None else confidence,
        confidence is not None,
    )


def _unit_normals(raw: RawDetections, problems: list[Problem]) -> Float64[ndarray, "n 3"]:
    count = len(raw.view_ids)
    if NORMAL[0] not in raw.numbers:
        return np.full((count, 3), np.nan)
    normal = np.column_stack([raw.numbers[name] for name in NORMAL]).reshape(-1, 3)
    absent = np.isnan(normal).all(axis=1)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        length = np.linalg.norm(normal, axis=1)
        invalid = ~absent & ~((length > 0) & (length < np.inf))
        unit = normal / length[:, None]
    expected = "three numbers that are not all 0, or none"
    problems += _problems(raw, np.flatnonzero(invalid), "the normal has no direction", expected)
    return np.where(invalid[:, None], np.nan, unit)


def _problems(raw: RawDetections, rows: ndarray, found: str, expected: str) -> list[Problem]:
    """Return a problem for each of the first rows whose problems are not known yet."""
    new = [row for row in rows[:MAX_REPORTED].tolist() if row not in raw.faulty]
    return [Problem("invalid", f"{raw.row_noun} {raw.lines[row]}", found, expected) for row in new]


MAX_ROWS_PER_VIEW = 5000
"""Largest number of detections of one view."""

_SCHEMA = pa.schema([(VIEW_ID, pa.string()), *((name, pa.float64()) for name in NUMBERS)])
_MAX_METADATA_CHARACTERS = 1000
_PARQUET_MAGIC = b"PAR1"


@dataclass(frozen=True, eq=False)
class DetectionFile:
    """File of detections without problems: its digest, what it declares, and its detections."""

    sha256: str
    meta: SubmissionMeta
    detections: Detections


def read_detections(
    path: Path, views: Mapping[str, object], declared: Mapping[str, object] | None = None
) -> DetectionFile:
    """Read a CSV or Parquet file of detections in some of ``views``, the ids of a dataset's views.

    ``declared`` replaces values of the file's metadata (``METADATA``); a method without a name is named after the
    file. Raises ``SubmissionError`` with all problems: a file that cannot be read or is larger than
    ``DETECTIONS_BYTES``, missing columns, values that are no numbers, unknown views, more than
    ``MAX_ROWS_PER_VIEW`` rows of a view, and rows of several splits of a config.
    """
    problems: list[Problem] = []
    raw = _read(path, problems)
    detections = None
    if raw is not None:
        detections = checked_detections(raw, problems)
        problems += _view_problems(raw, views)
    given = {key: value for key, value in (declared or {}).items() if value is not None}
    meta = _metadata(raw.metadata if raw is not None else {}, given, path, problems)
    if raw is None or detections is None or meta is None or problems:
        raise SubmissionError.from_problems(path, problems)
    return DetectionFile(f"sha256:{file_sha256(path)}", meta, detections)


def _read(path: Path, problems: list[Problem]) -> RawDetections | None:
    try:
        with open_regular(path) as stream:
            is_parquet = stream.read(4) == _PARQUET_MAGIC
    except OSError as error:
        problems.append(Problem("unreadable", "", f"cannot be read: {error.strerror or error}", "a file"))
        return None
    return _read_parquet(path, problems) if is_parquet else _read_csv(path, problems)


def _read_csv(path: Path, problems: list[Problem]) -> RawDetections | None:
    content = read_file(path, DETECTIONS_BYTES, "a CSV or Parquet file of detections", SubmissionError)
    text, undecoded = decode_text(content)
    if undecoded:
        problems += undecoded
        return None
    metadata, first = _csv_metadata(text)
    reader = csv.reader(islice(io.StringIO(text, newline=None), first, None), strict=True)
    try:
        rows = ((first + reader.line_num, row) for row in reader if row)
        _, head = next(rows, (0, []))
        names = [name.strip() for name in head]
        faults = column_problems(names)
        problems += faults
        return None if faults else _csv_rows(rows, names, metadata, problems)
    except csv.Error as error:
        where = f"line {first + reader.line_num}"
        problems.append(Problem("syntax", where, f"it is not CSV: {escape_text(str(error))}"))
        return None


def _csv_metadata(text: str) -> tuple[dict[str, str], int]:
    """Return the values of the lines ``# key: value`` at the start of a CSV, and the number of these lines."""
    metadata: dict[str, str] = {}
    count = 0
    for line in io.StringIO(text, newline=None):
        if not line.startswith("#"):
            break
        count += 1
        key, _, value = line[1:].partition(":")
        if key.strip() in METADATA:
            metadata[key.strip()] = value.strip()
    return metadata, count


def _csv_rows(
    rows: Iterator[tuple[int, list[str]]], names: list[str], metadata: Mapping[str, str], problems: list[Problem]
) -> RawDetections:
    view_ids: list[str] = []
    lines: list[int] = []
    used = [name for name in NUMBERS if name in names]
    places = [names.index(name) for name in used]
    id_place = names.index(VIEW_ID)
    values: list[list[float]] = []
    faulty: set[int] = set()
    for line, row in rows:
        if len(row) != len(names):
            if len(problems) < MAX_REPORTED:
                found = f"the row has {len(row)} values"
                problems.append(Problem("invalid", f"line {line}", found, f"{len(names)} as the head"))
            continue
        cells = [row[place].strip() for place in places]
        numbers = [parse_number(cell) if cell else np.nan for cell in cells]
        for name, cell, value in zip(used, cells, numbers, strict=True):
            if cell and math.isnan(value):
                faulty.add(len(lines))
                if len(problems) < MAX_REPORTED:
                    found = f"got {escape_text(cell)}"
                    problems.append(Problem("invalid", f"line {line}: {name}", found, "a number"))
        view_ids.append(row[id_place].strip())
        lines.append(line)
        values.append(numbers)
    table = np.array(values, dtype=np.float64).reshape(-1, len(used))
    columns = dict(zip(used, table.T, strict=True))
    return RawDetections(view_ids, columns, lines, metadata, "line", frozenset(faulty))


def _read_parquet(path: Path, problems: list[Problem]) -> RawDetections | None:
    max_bytes = DETECTIONS_BYTES.value()
    optional = frozenset((VIEW_ID, *NUMBERS))
    table = Table(_SCHEMA, max_bytes // 32, max_bytes, optional=optional)
    try:
        with open_regular(path) as stream, open_parquet(stream, table) as file:
            names = file.schema_arrow.names
            if faults := column_problems(names):
                problems += faults
                return None
            metadata = _parquet_metadata(file.schema_arrow.metadata or {})
            columns = [name for name in _SCHEMA.names if name in names]
            schema = pa.schema([_SCHEMA.field(name) for name in columns])
            read = file.read(columns=columns, use_threads=False).select(columns).cast(schema)
    except Exception as error:  # pyarrow raises many types, which depend on the damage.
        reason = library_message(error)
        problems.append(Problem("damaged", "", f"cannot be read as a table of detections: {reason}"))
        return None
    numbers = {
        name: read[name].to_numpy(zero_copy_only=False).astype(np.float64) for name in columns if name != VIEW_ID
    }
    view_ids = ["" if view_id is None else view_id for view_id in read[VIEW_ID].to_pylist()]
    return RawDetections(view_ids, numbers, range(1, len(view_ids) + 1), metadata, "row")


def _parquet_metadata(stored: Mapping[bytes, bytes]) -> dict[str, str]:
    found = {key: stored[key.encode()] for key in METADATA if key.encode() in stored}
    return {key: value[:_MAX_METADATA_CHARACTERS].decode(errors="replace") for key, value in found.items()}


def _view_problems(raw: RawDetections, views: Mapping[str, object]) -> Iterator[Problem]:
    """Yield the problems of the ids of views: unknown ones, too many rows of one, several splits of a config."""
    counts = Counter(raw.view_ids)
    unknown = [view_id for view_id in counts if view_id not in views]
    first = {view_id: row for row, view_id in reversed(list(enumerate(raw.view_ids)))} if unknown else {}
    for view_id in unknown[:MAX_REPORTED]:
        found = f"the view {escape_text(view_id)} is not in the dataset"
        where = f"{raw.row_noun} {raw.lines[first[view_id]]}"
        yield Problem("unknown", where, found, f"ids such as {next(iter(views), 'lattice/0000')}")
    for view_id, count in counts.items():
        if count > MAX_ROWS_PER_VIEW:
            yield Problem("size", escape_text(view_id), f"it has {count} rows", f"at most {MAX_ROWS_PER_VIEW}")
    splits: dict[str, set[str]] = {}
    for view_id in counts.keys() - set(unknown):
        if split := split_of(view_id):
            splits.setdefault(config_of(view_id), set()).add(split)
    for config, names in sorted(splits.items()):
        if len(names) > 1:
            found = f"rows of the splits {', '.join(sorted(names))}"
            yield Problem("conflict", config, found, "one split of a config")


def _metadata(
    stored: Mapping[str, str], given: Mapping[str, object], path: Path, problems: list[Problem]
) -> SubmissionMeta | None:
    """Return what a file and the options declare; text of the file is converted."""
    values: dict[str, object] = {key: value for key, value in stored.items() if value}
    flag = str(values.get("uses_ground_truth", "")).lower()
    if flag in ("true", "false"):
        values["uses_ground_truth"] = flag == "true"
    values |= given
    values.setdefault("method", path.stem)
    return validate_table(SubmissionMeta, values, problems, "metadata")
