"""Prediction runs: apply a method to a dataset folder and write the submission archive.

Predictions are stored view by view in a folder beside the archive, so that an interrupted run is resumed and loses
at most one view.
"""

from __future__ import annotations

import json
import platform
import shutil
import sys
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from rebar_depth_bench.atomic_io import atomic_replace, write_text
from rebar_depth_bench.data.dataset import decode_row, iterate_undecoded
from rebar_depth_bench.data.manifest import DatasetConfig, open_folder
from rebar_depth_bench.errors import InputError, MethodError, RebarDepthError
from rebar_depth_bench.methods import AnyMethod, ConfigViews, Method, MultiViewMethod, Predictor, Prepared
from rebar_depth_bench.progress import Progress, silent
from rebar_depth_bench.submission import SubmissionWriter
from rebar_depth_bench.version import software_version

_KEY_FILE = "key.json"


@dataclass(frozen=True)
class PreparationReport:
    """Notes of a multi-view method on preparing one config (plain JSON values), and the duration in seconds.

    ``seconds`` is None if an interrupted run had already done part of the work.
    """

    notes: Mapping[str, Any]
    seconds: float | None


@dataclass(frozen=True)
class PredictedViews:
    """Folder with one ``.npz`` file per predicted view; files are written atomically."""

    path: Path

    @classmethod
    def open(cls, path: Path, key: Mapping[str, Any]) -> PredictedViews:
        """Open the folder at ``path``, and empty it if it was made for another ``key``.

        ``key`` holds everything that determines the predictions. Raises ``InputError`` if the folder cannot be
        written.
        """
        key_json = json.dumps(key, sort_keys=True)
        try:
            if (path / _KEY_FILE).is_file() and (path / _KEY_FILE).read_text() == key_json:
                return cls(path)
            shutil.rmtree(path, ignore_errors=True)
            path.mkdir(parents=True)
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror}") from None
        write_text(path / _KEY_FILE, key_json)
        return cls(path)

    def __len__(self) -> int:
        return sum(1 for _ in self.path.glob("*/*.npz"))

    def __contains__(self, view_id: str) -> bool:
        return self._view_file(view_id).is_file()

    def put(self, view_id: str, depth_m: Float[ndarray, "h w"], seconds: float) -> None:
        """Store the depth of a view and its runtime in seconds."""
        with atomic_replace(self._view_file(view_id)) as temporary, temporary.open("wb") as stream:
            np.savez(stream, depth_m=depth_m, seconds=seconds)

    def get(self, view_id: str) -> tuple[Float[ndarray, "h w"], float]:
        """Return the stored depth and runtime in seconds of a view."""
        with np.load(self._view_file(view_id), allow_pickle=False) as stored:
            return stored["depth_m"], float(stored["seconds"])

    def work_folder(self, config: str) -> Path:
        """Return the folder for a method's intermediate files of a config; created if missing."""
        folder = self.path / f"{config}.work"
        folder.mkdir(exist_ok=True)
        return folder

    def put_preparation(self, config: str, preparation: PreparationReport) -> None:
        """Store the preparation report of a config."""
        write_text(self._preparation_file(config), json.dumps(vars(preparation)))

    def get_preparation(self, config: str) -> PreparationReport | None:
        """Return the preparation report of a config, or None if its preparation was never completed."""
        path = self._preparation_file(config)
        return PreparationReport(**json.loads(path.read_text())) if path.is_file() else None

    def _view_file(self, view_id: str) -> Path:
        return self.path / f"{view_id}.npz"

    def _preparation_file(self, config: str) -> Path:
        return self.path / f"{config}.json"


def predict(
    method: AnyMethod,
    root: str | Path,
    archive: str | Path,
    *,
    configs: Sequence[str] | None = None,
    progress: Progress = silent,
) -> dict[str, PreparationReport]:
    """Predict every view of the named configs (default: all) and write the archive atomically.

    Each view is stored beside the archive until all are predicted: after an interruption, the same call predicts
    only the missing ones. ``submission.json`` records the seconds per view and, for multi-view methods, their
    notes on each config. Returns the preparation report of each config that a multi-view method prepared.

    Raises ``DatasetError`` for an unknown folder or config, ``InputError`` if ``archive`` is a folder, and
    ``MethodError`` if the method cannot run or returns invalid values.
    """
    folder = open_folder(root)
    chosen = [folder.config(name) for name in dict.fromkeys(configs or folder.configs)]
    target = Path(archive)
    if target.is_dir():
        raise InputError(f"{target}: is a folder, expected the name of the archive to write")
    key = {
        "method": vars(method.info),
        "dataset": {config.name: [config.key, config.ground_truth_digest] for config in chosen},
        "software": software_version(),
    }
    if isinstance(method, MultiViewMethod):
        for config in chosen:
            with _wrap_errors(f"{method.info.name}: {config.name}: check"):
                method.check(ConfigViews(config))
    # Loading comes first so that its errors occur before anything is written.
    loaded = _load_method(method) if isinstance(method, Method) else None
    views = PredictedViews.open(target.with_name(f".{target.name}.views"), key)
    if len(views):
        print(f"resuming: {len(views)} views are in {views.path}; delete it to start over", file=sys.stderr)
    for config in chosen:
        done = [view_id for view_id in config.view_ids if view_id in views]
        if len(done) == len(config.views):
            continue
        predictor = loaded or _prepare_method(method, ConfigViews(config), views, progress)
        for count, row in enumerate(_remaining_rows(method, config, set(done)), start=len(done) + 1):
            start = time.perf_counter()
            with _wrap_errors(f"{method.info.name}: {row['view_id']}: the predictor, given {', '.join(row)}"):
                prediction = predictor(row)
            depth_m = _validated_depth(method, row["view_id"], prediction, config.grid)
            views.put(row["view_id"], depth_m, time.perf_counter() - start)
            progress(f"{method.info.name} on {config.name}", count, len(config.views))
    reports = {config.name: report for config in chosen if (report := views.get_preparation(config.name))}
    _write_archive(method, target, views, [view_id for config in chosen for view_id in config.view_ids], reports)
    shutil.rmtree(views.path)
    return reports


def _load_method(method: Method) -> Predictor:
    """Return the predictor of a single-view method. Raises ``MethodError`` if ``load`` fails."""
    with _wrap_errors(f"{method.info.name}: load"):
        predictor = method.load()
    if not callable(predictor):
        raise MethodError(
            f"{method.info.name}: load returned {type(predictor).__name__}, expected a function of a row"
        )
    return predictor


@contextmanager
def _wrap_errors(what: str) -> Iterator[None]:
    """Convert exceptions of a method's code into ``MethodError`` with ``what`` failed and the source line.

    Errors of this project (``RebarDepthError``) pass unchanged.
    """
    try:
        yield
    except RebarDepthError:
        raise
    except Exception as error:
        frame = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{frame.filename}:{frame.lineno}"
        raise MethodError(f"{what}: raised {type(error).__name__}: {error} ({where})") from error


def _check_notes(method: AnyMethod, config: ConfigViews, prepared: Prepared) -> None:
    """Raise ``MethodError`` unless all notes are plain JSON values."""
    for key, value in prepared.notes.items():
        try:
            json.dumps({key: value}, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise MethodError(
                f"{method.info.name}: {config.config}: the note {key!r} is not a plain JSON value: {error}"
            ) from None


def _prepare_method(
    method: AnyMethod, config: ConfigViews, views: PredictedViews, progress: Progress
) -> Predictor:
    """Return the predictor of a multi-view method for a config, and store its preparation report."""
    assert isinstance(method, MultiViewMethod)
    work = views.work_folder(config.config)
    started_from_scratch = not any(work.iterdir())
    start = time.perf_counter()
    with _wrap_errors(f"{method.info.name}: {config.config}: prepare"):
        prepared = method.prepare(config, work, progress)
    if not isinstance(prepared, Prepared):
        raise MethodError(f"{method.info.name}: prepare returned {type(prepared).__name__}, expected a Prepared")
    _check_notes(method, config, prepared)
    if views.get_preparation(config.config) is None:
        seconds = round(time.perf_counter() - start, 1)
        views.put_preparation(
            config.config, PreparationReport(prepared.notes, seconds if started_from_scratch else None)
        )
    return prepared.predict


def _remaining_rows(method: AnyMethod, config: DatasetConfig, done: set[str]) -> Iterator[dict[str, Any]]:
    """Yield the decoded rows of the views that are not in ``done``; the others are not decoded."""
    columns = ("view_id", *method.info.columns)
    for row in iterate_undecoded(config, columns):
        if row["view_id"] not in done:
            yield decode_row(row)


def _validated_depth(
    method: AnyMethod, view_id: str, depth_m: object, grid: tuple[int, int]
) -> Float[ndarray, "h w"]:
    """Return a prediction as an array. Raises ``MethodError`` unless it is floating point of shape ``grid``."""
    array = np.asarray(depth_m)
    if array.shape != grid or array.dtype.kind != "f":
        raise MethodError(
            f"{method.info.name}: {view_id}: the method returned {array.dtype} of shape {array.shape}, expected "
            f"float metres of shape {grid}"
        )
    return array


def _write_archive(
    method: AnyMethod,
    archive: Path,
    views: PredictedViews,
    view_ids: Sequence[str],
    reports: dict[str, PreparationReport],
) -> None:
    """Write the stored predictions of ``view_ids`` into the archive, with runtimes and notes."""
    info = method.info
    runtime: dict[str, Any] = {
        "unit": "seconds",
        "python": platform.python_version(),
        "machine": platform.machine(),
    }
    if reports:
        runtime["preparing"] = {config: report.seconds for config, report in reports.items()}
    with SubmissionWriter(
        archive,
        method=info.name,
        description=info.summary,
        uses_intrinsics=info.uses_intrinsics,
        runtime=runtime,
        notes={config: report.notes for config, report in reports.items()} or None,
    ) as writer:
        for view_id in view_ids:
            depth_m, seconds = views.get(view_id)
            writer.add(view_id, depth_m, round(seconds, 4))
