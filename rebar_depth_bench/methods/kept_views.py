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
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from rebar_depth_bench.base.errors import EntryError, InputError, Problem, escape_text
from rebar_depth_bench.base.limits import JSON_BYTES
from rebar_depth_bench.base.names import NAME_PATTERN
from rebar_depth_bench.base.reading import FileSource, parse_json, path_below, read_file, remove_folder
from rebar_depth_bench.base.terminal import print_notice
from rebar_depth_bench.base.validation import Expected, StrictModel, validate_table
from rebar_depth_bench.base.writing import named_write_errors, write_bytes, write_error, write_text
from rebar_depth_bench.data.rows import Views
from rebar_depth_bench.submission.maps import decode_npy, max_npy_bytes
from rebar_depth_bench.submission.zip import read_data, read_entries

_RUN_FILE, _WORK_SUFFIX = "run.json", ".work"
_SECONDS = "seconds"
_TOP_FILES, _VIEW_FILES = re.compile(r"run\.json|\..*\.tmp"), re.compile(rf"{NAME_PATTERN}\.npz|\..*\.tmp")
_MAX_ITEM_BYTES = 8


class PreparationReport(StrictModel):
    """Notes of a method on one config (plain JSON values), and the seconds of a multi-view method's preparation.

    ``seconds`` is None if an interrupted run had already done part of the work, and for single-view methods.
    """

    notes: Annotated[dict[str, Any], Expected("a table of notes")]
    seconds: Annotated[float, Expected("a number of at least 0", lambda value: 0 <= value < math.inf)] | None


class Run(StrictModel):
    """Content of ``run.json``: everything that determines the predictions, and the reports by config.

    The reports are those of completed preparations; see ``KeptViews.put_report``.
    """

    key: Annotated[dict[str, Any], Expected("a table")]
    reports: dict[str, PreparationReport]


@dataclass(frozen=True)
class KeptViews:
    """Folder with ``run.json``, a work folder per config, and one ``.npz`` file per predicted view.

    A view's file holds two arrays: the depth, named after the view, and the runtime. Each file is written
    atomically, so that an interruption at any time loses at most the view being predicted.
    """

    path: Path
    run: Run

    @classmethod
    def open(cls, path: Path, key: Mapping[str, Any]) -> KeptViews:
        """Open the folder at ``path``, and empty it if it was made for another ``key``.

        ``key`` holds everything that determines the predictions, as JSON values. Raises ``InputError`` if the
        folder is a link or holds anything else, and ``OutputError`` if it cannot be written.
        """
        stored_key: dict[str, Any] = json.loads(json.dumps(key))
        try:
            if os.path.lexists(path):
                _refuse_foreign(path)
                run = _read_run(path / _RUN_FILE)
                if run is not None and run.key == stored_key:
                    return cls(path, run)
                found = "another method, dataset or version" if run else f"a run without a readable {_RUN_FILE}"
                if views := sum(1 for _ in path.glob("*/*.npz")):
                    print_notice(f"starting over: {path} holds {views} views of {found}")
                remove_folder(path)
            path.mkdir(parents=True)
        except OSError as error:
            raise write_error(path, error) from None
        kept = cls(path, Run(key=stored_key, reports={}))
        kept._write_run()
        return kept

    def usable(self, views: Sequence[Views]) -> set[str]:
        """Return the ids of views that need not be predicted again, with notices on them and on damaged ones."""
        usable, errors = set(), list[InputError]()
        for config in views:
            for view_id in config.view_ids:
                if self._view_file(view_id).exists():
                    try:
                        self.get(view_id, config.grid)
                        usable.add(view_id)
                    except InputError as error:
                        errors.append(error)
        if usable:
            print_notice(f"resuming: {len(usable)} views are in {self.path}; delete it to start over")
        if errors:
            first = " ".join(str(errors[0]).split())
            print_notice(f"kept predictions that cannot be used are made again ({len(errors)}): {first}")
        return usable

    def put(self, view_id: str, depth_m: Float[ndarray, "h w"], seconds: float) -> None:
        """Store the depth of a view and its runtime in seconds."""
        # The archive holds longdouble as float32, too.
        stored = depth_m if depth_m.dtype.itemsize <= _MAX_ITEM_BYTES else depth_m.astype(np.float32)
        content = io.BytesIO()
        np.savez(content, **{view_id: stored, _SECONDS: np.array([[seconds]])})
        write_bytes(self._view_file(view_id), content.getvalue())

    def get(self, view_id: str, grid: tuple[int, int]) -> tuple[Float[ndarray, "h w"], float]:
        """Return the stored depth and runtime in seconds of a view.

        Sizes are checked before anything is allocated. Raises ``InputError`` if the file is missing or damaged, or
        holds another view or depth of another shape.
        """
        path, shapes = self._view_file(view_id), {f"{view_id}.npy": grid, f"{_SECONDS}.npy": (1, 1)}
        try:
            with closing(FileSource(path)) as source:
                found = read_entries(source, len(shapes), lambda name: max_npy_bytes(shapes.get(name, (0, 0))))
                problems = [problem for entry in found for problem in entry.problems]
                entries = {entry.name: entry for entry in found}
                if entries.keys() != shapes.keys():
                    names = f"the arrays are {escape_text(', '.join(entries))}"
                    problems.append(Problem("conflict", "", names, ", ".join(shapes)))
                if problems:
                    raise EntryError(problems[0])
                depth_m, seconds = (
                    decode_npy(name, read_data(source, entries[name]), shape) for name, shape in shapes.items()
                )
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

    def put_report(self, config: str, report: PreparationReport) -> None:
        """Store the preparation report of a config."""
        self.run.reports[config] = report
        self._write_run()

    def remove(self) -> None:
        """Delete the folder."""
        remove_folder(self.path)

    def _view_file(self, view_id: str) -> Path:
        return path_below(self.path, f"{view_id}.npz")

    def _write_run(self) -> None:
        write_text(self.path / _RUN_FILE, json.dumps(self.run.model_dump()))


def _read_run(path: Path) -> Run | None:
    """Return the content of ``run.json``, None if it is missing or damaged."""
    try:
        values, problems = parse_json(read_file(path, JSON_BYTES, "the parameters of a run", InputError))
    except InputError:
        return None
    return None if problems else validate_table(Run, values, problems)


def _refuse_foreign(path: Path) -> None:
    """Raise ``InputError`` if ``path`` is no folder, or holds a file or folder whose name or kind is not ours."""
    expected = "expected a folder with predictions of an interrupted run only"
    if not stat.S_ISDIR(path.lstat().st_mode):
        raise InputError(f"{path}: is not a folder, {expected}")

    def refuse(error: OSError) -> None:
        raise InputError(f"{error.filename}: cannot be read: {error.strerror}")

    for top, folders, files in os.walk(path, onerror=refuse):
        is_top = top == str(path)
        for entry in sorted(Path(top, name) for name in (*folders, *files)):
            mode, pattern = entry.lstat().st_mode, _TOP_FILES if is_top else _VIEW_FILES
            is_our_folder = is_top and stat.S_ISDIR(mode) and re.fullmatch(NAME_PATTERN, entry.name)
            if not is_our_folder and not (stat.S_ISREG(mode) and pattern.fullmatch(entry.name)):
                raise InputError(f"{entry}: is not part of kept predictions, {expected}")
        if is_top and folders and _RUN_FILE not in files:
            raise InputError(f"{path}: has no {_RUN_FILE}, {expected}")
        # Methods store what they like in their work folders.
        folders[:] = [name for name in folders if not name.endswith(_WORK_SUFFIX)]
