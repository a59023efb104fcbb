"""Predictions that are kept in a folder beside the archive until all views are predicted."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from pydantic import NonNegativeFloat

from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.base.limits import JSON_BYTES
from rebar_depth_bench.base.reading import (
    FileSource,
    check_no_links,
    parse_json,
    path_below,
    read_file,
    remove_folder,
)
from rebar_depth_bench.base.terminal import print_notice
from rebar_depth_bench.base.validation import StrictModel, validate_table
from rebar_depth_bench.base.writing import write_bytes, write_error, write_text
from rebar_depth_bench.data.rows import Views
from rebar_depth_bench.submission.maps import decode_npz

_RUN_FILE = "run.json"
_RUNTIME_BYTES = 8


class PreparationReport(StrictModel):
    """Notes of a method on one config (plain JSON values), and the seconds of a multi-view method's preparation.

    ``seconds`` is None if an interrupted run had already done part of the work, and for single-view methods.
    """

    notes: dict[str, Any]
    seconds: NonNegativeFloat | None


class Run(StrictModel):
    """Content of ``run.json``: all that determines the predictions, and reports of preparations by config."""

    key: dict[str, Any]
    reports: dict[str, PreparationReport]


@dataclass(frozen=True)
class KeptViews:
    """Folder with ``run.json``, one file per predicted view, and the files of multi-view methods.

    A view's file is an ``.npz`` archive with the depth, and behind it the runtime in microseconds. Each file is
    written atomically, so that an interruption at any time loses at most the view being predicted.
    """

    path: Path
    run: Run

    @classmethod
    def open(cls, path: Path, key: Mapping[str, Any]) -> KeptViews:
        """Open the folder at ``path``, and empty it if it was made for another ``key``.

        ``key`` holds everything that determines the predictions, as JSON values. Raises ``InputError`` if ``path``
        is neither a folder with ``run.json`` nor an empty one, and ``OutputError`` if it cannot be written.
        """
        run = Run(key=json.loads(json.dumps(key)), reports={})
        check_no_links(path.parent, path.name)
        try:
            if (path / _RUN_FILE).is_file():
                values, problems = parse_json(read_file(path / _RUN_FILE, JSON_BYTES, "a run", InputError))
                stored = None if problems else validate_table(Run, values, problems)
                if stored is not None and stored.key == run.key:
                    return cls(path, stored)
                print_notice(f"starting over: {path} is of another method, dataset or version")
                remove_folder(path)
            elif path.exists() and any(path.iterdir()):
                raise InputError(f"{path}: has no {_RUN_FILE}, expected predictions of an interrupted run only")
            write_text(path / _RUN_FILE, json.dumps(run.model_dump()))
        except OSError as error:
            raise write_error(path, error) from None
        return cls(path, run)

    def usable(self, views: Sequence[Views]) -> set[str]:
        """Return the ids of the views that need not be predicted again, with a notice on them."""
        usable = set()
        for config in views:
            for view_id in config.view_ids:
                with suppress(InputError, OSError):  # A missing or damaged view is predicted again.
                    self.get(view_id, config.grid)
                    usable.add(view_id)
        if usable:
            print_notice(f"resuming: {len(usable)} views are in {self.path}; delete it to start over")
        return usable

    def put(self, view_id: str, depth_m: Float[ndarray, "h w"], seconds: float) -> None:
        """Store the depth of a view and its runtime in seconds."""
        content = io.BytesIO()
        # The archive holds longdouble as float32, too.
        np.savez(content, depth_m if depth_m.dtype.itemsize <= 8 else depth_m.astype(np.float32))
        runtime = round(seconds * 1e6).to_bytes(_RUNTIME_BYTES, "little")
        write_bytes(self.path_of(f"{view_id}.npz"), content.getvalue() + runtime)

    def get(self, view_id: str, grid: tuple[int, int]) -> tuple[Float[ndarray, "h w"], float]:
        """Return the stored depth and runtime in seconds of a view.

        Raises ``OSError`` if the file cannot be read, and ``EntryError`` if it is damaged or has another shape.
        """
        path = self.path_of(f"{view_id}.npz")
        with closing(FileSource(path)) as source:
            content = source.read_at(0, source.size)
        depth_m = decode_npz(str(path), content[:-_RUNTIME_BYTES], grid)
        return depth_m, int.from_bytes(content[-_RUNTIME_BYTES:], "little") / 1e6

    def path_of(self, name: str) -> Path:
        """Return the path of a file or folder. Raises ``InputError`` if it is elsewhere, also by a link."""
        check_no_links(self.path, name)
        return path_below(self.path, name)

    def put_report(self, config: str, report: PreparationReport) -> None:
        """Store the preparation report of a config."""
        self.run.reports[config] = report
        write_text(self.path / _RUN_FILE, json.dumps(self.run.model_dump()))
