"""Arrays of many views kept as a few flat files: written and read view by view.

A cache is a folder: ``views.json`` with the views' ids, where each one's part starts and a note of each, and a
file of raw values per array. It appears under its name whole or not at all.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from rebar_depth_bench.files import sync

_OUTLINE = "views.json"


@dataclass(frozen=True, eq=False)
class ViewArrays:
    """One view's part: arrays of one length by name, and a small JSON-able note."""

    view_id: str
    arrays: Mapping[str, ndarray]
    note: Any


@dataclass(frozen=True, eq=False)
class FlatCache:
    """All views' parts, in order; each is read when it is asked for, so that memory holds only those in use."""

    path: Path
    dtypes: Mapping[str, type]
    view_ids: tuple[str, ...]
    starts: tuple[int, ...]
    notes: tuple[Any, ...]

    def __len__(self) -> int:
        return len(self.view_ids)

    def view(self, place: int) -> ViewArrays:
        """Return the view at ``place``; threads may ask at once."""
        start, end = self.starts[place], self.starts[place + 1]
        arrays: dict[str, ndarray] = {
            name: np.fromfile(self.path / name, dtype, end - start, offset=start * np.dtype(dtype).itemsize)
            for name, dtype in self.dtypes.items()
        }
        return ViewArrays(self.view_ids[place], arrays, self.notes[place])


def open_cache(
    path: Path, dtypes: Mapping[str, type], fill: Callable[[], Iterator[ViewArrays]], *, outdated: str
) -> FlatCache:
    """Return the cache at ``path``; where there is none or a damaged one, write it from the views ``fill`` yields.

    ``outdated`` is a pattern of names beside it that a new cache replaces. Filling holds one view in memory.
    """
    try:
        return _read(path, dtypes)
    except (OSError, ValueError, KeyError, TypeError):
        shutil.rmtree(path, ignore_errors=True)  # not there, or damaged
    path.parent.mkdir(parents=True, exist_ok=True)
    for old in path.parent.glob(outdated):
        shutil.rmtree(old, ignore_errors=True)
    temporary = Path(tempfile.mkdtemp(prefix=".filling-", dir=path.parent))
    try:
        _write(temporary, dtypes, fill())
        temporary.rename(path)
    except OSError:
        if not path.is_dir():  # else another process was faster, with the same bytes
            raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return _read(path, dtypes)


def _read(path: Path, dtypes: Mapping[str, type]) -> FlatCache:
    outline = json.loads((path / _OUTLINE).read_text())
    starts = tuple(outline["starts"])
    for name, dtype in dtypes.items():
        found, expected = (path / name).stat().st_size, starts[-1] * np.dtype(dtype).itemsize
        if found != expected:
            raise ValueError(f"{path / name}: {found} bytes, expected {expected}")
    return FlatCache(path, dtypes, tuple(outline["view_ids"]), starts, tuple(outline["notes"]))


def _write(into: Path, dtypes: Mapping[str, type], views: Iterator[ViewArrays]) -> None:
    view_ids, starts, notes = [], [0], []
    with ExitStack() as stack:
        files = {name: stack.enter_context((into / name).open("wb")) for name in dtypes}
        for view in views:
            for name, dtype in dtypes.items():
                files[name].write(np.ascontiguousarray(view.arrays[name], dtype).data)
            view_ids.append(view.view_id)
            starts.append(starts[-1] + len(view.arrays[next(iter(dtypes))]))
            notes.append(view.note)
    (into / _OUTLINE).write_text(json.dumps({"view_ids": view_ids, "starts": starts, "notes": notes}))
    for path in (*into.iterdir(), into):
        sync(path)
