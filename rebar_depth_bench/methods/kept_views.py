"""Predictions that are kept in a folder beside the archive until all views are predicted.

The folder and its files are checked before they are reused or deleted: they may be damaged, renamed or not ours.
"""

from __future__ import annotations

import io
import json
import math
import os
import re
import stat
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from rebar_depth_bench.atomic_io import named_write_errors, write_bytes, write_error, write_text
from rebar_depth_bench.errors import EntryError, InputError, Problem, escape_text
from rebar_depth_bench.limits import JSON_BYTES
from rebar_depth_bench.names import NAME_PATTERN
from rebar_depth_bench.reading import FileSource, parse_json, path_below, read_file, remove_folder
from rebar_depth_bench.submission.maps import Depth, decode_npy, max_npy_bytes
from rebar_depth_bench.submission.zip import read_data, read_entries
from rebar_depth_bench.terminal import print_notice
from rebar_depth_bench.validation import Expected, StrictModel, validate_table

_KEY_FILE = "key.json"
_SECONDS = "seconds"
_WORK_SUFFIX = ".work"
_FILES = re.compile(rf"{NAME_PATTERN}\.json|\..*\.tmp")
_VIEW_FILES = re.compile(rf"{NAME_PATTERN}\.npz|\..*\.tmp")
_MAX_ITEM_BYTES = 8


class PreparationReport(StrictModel):
    """Notes of a method on one config (plain JSON values), and the seconds of a multi-view method's preparation.

    ``seconds`` is None if an interrupted run had already done part of the work, and for single-view methods.
    """

    notes: Annotated[dict[str, Any], Expected("a table of notes")]
    seconds: Annotated[float, Expected("a number of at least 0", lambda value: 0 <= value < math.inf)] | None


@dataclass(frozen=True)
class KeptViews:
    """Folder with one ``.npz`` file per predicted view; files are written atomically.

    A file holds two arrays: the depth, named after the view, and the runtime.
    """

    path: Path

    @classmethod
    def open(cls, path: Path, key: Mapping[str, Any]) -> KeptViews:
        """Open the folder at ``path``, and empty it if it was made for another ``key``.

        ``key`` holds everything that determines the predictions. Raises ``InputError`` if the folder is a link or
        holds anything else, and ``OutputError`` if it cannot be written.
        """
        key_json = json.dumps(key, sort_keys=True)
        try:
            if os.path.lexists(path):
                if foreign := _foreign_entry(path):
                    raise InputError(f"{foreign}, expected a folder with predictions of an interrupted run only")
                if _is_key(path / _KEY_FILE, key_json):
                    return cls(path)
                views = sum(1 for _ in path.glob("*/*.npz"))
                print_notice(f"starting over: {path} holds {views} views of another method, dataset or version")
                remove_folder(path)
            path.mkdir(parents=True)
        except OSError as error:
            raise write_error(path, error) from None
        write_text(path / _KEY_FILE, key_json)
        return cls(path)

    def check(self, view_ids: Iterable[str], grid: tuple[int, int]) -> tuple[set[str], list[InputError]]:
        """Return those of the views that can be reused, and the errors of those that are damaged."""
        usable, errors = set(), []
        for view_id in view_ids:
            if self._view_file(view_id).exists():
                try:
                    self.get(view_id, grid)
                    usable.add(view_id)
                except InputError as error:
                    errors.append(error)
        return usable, errors

    def put(self, view_id: str, depth_m: Float[ndarray, "h w"], seconds: float) -> None:
        """Store the depth of a view and its runtime in seconds."""
        # The archive holds longdouble as float32, too.
        stored = depth_m if depth_m.dtype.itemsize <= _MAX_ITEM_BYTES else depth_m.astype(np.float32)
        content = io.BytesIO()
        np.savez(content, **{view_id: stored, _SECONDS: np.array([[seconds]])})
        write_bytes(self._view_file(view_id), content.getvalue())

    def get(self, view_id: str, grid: tuple[int, int]) -> tuple[Float[ndarray, "h w"], float]:
        """Return the stored depth and runtime in seconds of a view.

        Raises ``InputError`` if the file is missing or damaged, or holds another view or depth of another shape.
        """
        path = self._view_file(view_id)
        try:
            depth_m, seconds = _read_arrays(path, {f"{view_id}.npy": grid, f"{_SECONDS}.npy": (1, 1)})
        except EntryError as error:
            raise InputError.from_problems(path, error.problems) from None
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}") from None
        if not 0 <= seconds[0, 0] < math.inf:
            problem = Problem("invalid", _SECONDS, f"got {seconds[0, 0]}", "a number of at least 0")
            raise InputError.from_problems(path, [problem])
        return depth_m, float(seconds[0, 0])

    def work_folder(self, config: str) -> Path:
        """Return the folder for a method's intermediate files of a config; created if missing."""
        folder = path_below(self.path, f"{config}{_WORK_SUFFIX}")
        with named_write_errors(folder):
            folder.mkdir(exist_ok=True)
        return folder

    def put_preparation(self, config: str, preparation: PreparationReport) -> None:
        """Store the preparation report of a config."""
        write_text(self._preparation_file(config), json.dumps(preparation.model_dump()))

    def get_preparation(self, config: str) -> PreparationReport | None:
        """Return the preparation report of a config, or None if its preparation was never completed.

        Raises ``InputError`` if the report is damaged.
        """
        path = self._preparation_file(config)
        if not path.exists():
            return None
        values, problems = parse_json(read_file(path, JSON_BYTES, "a preparation report", InputError))
        report = None if problems else validate_table(PreparationReport, values, problems)
        if report is None:
            raise InputError.from_problems(path, problems)
        return report

    def remove(self) -> None:
        """Delete the folder."""
        remove_folder(self.path)

    def _view_file(self, view_id: str) -> Path:
        return path_below(self.path, f"{view_id}.npz")

    def _preparation_file(self, config: str) -> Path:
        return path_below(self.path, f"{config}.json")


def _foreign_entry(path: Path) -> str | None:
    """Return the place of a file that ``KeptViews`` does not write, with what is wrong; None if there is none."""
    if not stat.S_ISDIR(path.lstat().st_mode):
        return f"{path}: is not a folder"
    entries = list(path.iterdir())
    foreign = sorted(str(entry) for top in entries for entry in _foreign_files(top))
    if foreign:
        return f"{foreign[0]}: is not part of kept predictions"
    is_ours = any(entry.name == _KEY_FILE for entry in entries) or not any(entry.is_dir() for entry in entries)
    return None if is_ours else f"{path}: has no {_KEY_FILE}"


def _foreign_files(entry: Path) -> list[Path]:
    """Return an entry of the folder, or files of a config in it, whose name or kind is not ours."""
    mode = entry.lstat().st_mode
    if stat.S_ISREG(mode) and _FILES.fullmatch(entry.name):
        return []
    if not stat.S_ISDIR(mode) or not re.fullmatch(NAME_PATTERN, entry.name):
        return [entry]
    if entry.name.endswith(_WORK_SUFFIX):  # Methods store what they like there.
        return []
    return [file for file in entry.iterdir() if not _VIEW_FILES.fullmatch(file.name) or not _is_regular(file)]


def _is_regular(path: Path) -> bool:
    return stat.S_ISREG(path.lstat().st_mode)


def _is_key(path: Path, key_json: str) -> bool:
    try:
        return read_file(path, JSON_BYTES, "the key of kept predictions", InputError) == key_json.encode()
    except InputError:
        return False


def _read_arrays(path: Path, shapes: Mapping[str, tuple[int, int]]) -> list[Depth]:
    """Return the arrays of an ``.npz`` file, which has exactly the members of ``shapes``, in their order.

    Sizes are checked before anything is allocated. Raises ``EntryError`` or ``OSError``.
    """
    source = FileSource(path)
    try:
        found = read_entries(source, len(shapes), lambda name: max_npy_bytes(shapes.get(name, (0, 0))))
        problems = [problem for entry in found for problem in entry.problems]
        entries = {entry.name: entry for entry in found}
        if entries.keys() != shapes.keys():
            names = f"the arrays are {escape_text(', '.join(entries))}"
            problems.append(Problem("conflict", "", names, ", ".join(shapes)))
        if problems:
            raise EntryError(problems[0])
        return [decode_npy(name, read_data(source, entries[name]), shape) for name, shape in shapes.items()]
    finally:
        source.close()
