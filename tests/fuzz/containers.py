"""Seeded generators that damage zip archives, Parquet tables and images, and keep the container readable."""

from __future__ import annotations

import io
import struct
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tests.fuzz import hostile

_EXTREMES = (np.nan, np.inf, -np.inf, 0.0, -1.0, 1e308, 1e-308, 0.3)


def damage_zip(
    content: bytes,
    rng: np.random.Generator,
    damage_entry: Callable[[str, bytes, np.random.Generator], tuple[bytes, str]],
) -> bytes:
    """Damage, rename, repeat, delete or link one entry of a zip archive. Raises ``ValueError`` if it is none."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            entries = [(entry.filename, archive.read(entry)) for entry in archive.infolist()]
    except (zipfile.BadZipFile, struct.error, OSError, NotImplementedError) as error:
        raise ValueError("no zip archive") from error
    if not entries:
        raise ValueError("no entries")
    at, kind, mode = int(rng.integers(len(entries))), rng.integers(6), 0o100644
    name, data = entries.pop(at)
    if kind == 1:
        paths = (*hostile.PATHS, *hostile.TEXTS[:10])
        name = paths[rng.integers(len(paths))].decode("latin-1") + str(rng.choice(("", ".npy", ".png")))
    elif kind == 2:
        entries.insert(at, (name, data))
    elif kind == 3:
        mode = 0o120777
    elif kind != 4:
        data, _ = damage_entry(name, data, rng)
    if kind != 4:
        entries.insert(at, (name, data))
    return _zip(entries, name, mode, int(rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))))


def _zip(entries: list[tuple[str, bytes]], linked: str, mode: int, compression: int) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", compression) as archive:
        for name, data in entries:
            entry = zipfile.ZipInfo(name or "-")
            entry.compress_type = compression
            entry.external_attr = (mode if name == linked else 0o100644) << 16
            archive.writestr(entry, data)
    return out.getvalue()


def damage_parquet(
    content: bytes, rng: np.random.Generator, damage_bytes: Callable[[bytes, np.random.Generator], bytes]
) -> bytes:
    """Damage one cell, row or column of a Parquet table. Raises ``ValueError`` if it is none."""
    try:
        table = pq.read_table(io.BytesIO(content))
    except (OSError, pa.ArrowException) as error:
        raise ValueError("no Parquet table") from error
    names, rows = table.column_names, table.to_pylist()
    if not rows:
        raise ValueError("no rows")
    column, at, kind = names[rng.integers(len(names))], int(rng.integers(len(rows))), rng.integers(12)
    if kind == 0:
        return _parquet(table.drop_columns([column]))
    if kind == 1:
        return _parquet(table.rename_columns([f"{name}x" if name == column else name for name in names]))
    if kind == 2:
        return _parquet(pa.concat_tables([table, table.slice(at, 1)]))
    if kind == 3:
        return _parquet(pa.concat_tables([table.slice(0, at), table.slice(at + 1)]))
    if kind == 4:
        texts = pa.array([str(value)[:50] for value in table.column(column).to_pylist()])
        return _parquet(table.set_column(names.index(column), column, texts))
    cells = [row[column] for row in rows]
    cells[at] = cells[int(rng.integers(len(rows)))] if kind == 5 else _other_cell(cells[at], rng, damage_bytes)
    field = table.schema.field(column)
    try:
        array = pa.array(cells, field.type)
    except (pa.ArrowException, TypeError, OverflowError):  # The cell has another type or length now.
        array, field = pa.array([None if cell is None else str(cell) for cell in cells]), column
    return _parquet(table.set_column(names.index(column), field, array))


def _parquet(table: pa.Table) -> bytes:
    out = io.BytesIO()
    pq.write_table(table, out, row_group_size=1)
    return out.getvalue()


def _other_cell(
    cell: Any, rng: np.random.Generator, damage_bytes: Callable[[bytes, np.random.Generator], bytes]
) -> Any:
    if rng.random() < 0.1:
        return None
    if isinstance(cell, dict):  # An image: its bytes, and a path that nothing should open.
        if rng.random() < 0.2:
            return {**cell, "bytes": None, "path": hostile.PATHS[rng.integers(len(hostile.PATHS))].decode()}
        return {**cell, "bytes": _other_cell(cell["bytes"], rng, damage_bytes)}
    if isinstance(cell, bytes):
        return damage_image_size(cell, rng) if rng.random() < 0.4 else damage_bytes(cell, rng)
    if isinstance(cell, list):
        if rng.random() < 0.2:
            return cell[:-1]
        at = int(rng.integers(len(cell)))
        return [*cell[:at], _other_cell(cell[at], rng, damage_bytes), *cell[at + 1 :]]
    if isinstance(cell, str):
        texts = (*hostile.PATHS, *hostile.TEXTS)
        return texts[rng.integers(len(texts))].decode("latin-1")
    return float(rng.choice(_EXTREMES)) if isinstance(cell, float) else int(rng.integers(-5, 1 << 31))


def damage_image_size(content: bytes, rng: np.random.Generator) -> bytes:
    """Declare another size in the header of an image."""
    return hostile.declare_image_size(content, *hostile.other_image_size(rng))
