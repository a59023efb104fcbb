"""Run a method over a dataset folder into a submission archive; stopped and run again, it goes on.

Predictions kept view by view while a method runs, so that an interruption costs one view.
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

from rebar_depth_bench.atomic_io import replacing, write_text
from rebar_depth_bench.data.dataset import decode_row, load_undecoded
from rebar_depth_bench.data.manifest import DatasetFolder, open_folder
from rebar_depth_bench.errors import InputError, MethodError, RebarDepthError
from rebar_depth_bench.methods import AnyMethod, ConfigViews, Method, MultiViewMethod, Predictor, Prepared
from rebar_depth_bench.progress import Progress, silent
from rebar_depth_bench.submission import SubmissionWriter
from rebar_depth_bench.version import software_version

_KEY = "key.json"


@dataclass(frozen=True)
class Preparation:
    """What a method that sees a whole config found on the way, plain JSON values, and how long it took.

    ``seconds`` is None where an interrupted run left part of the work done.
    """

    notes: Mapping[str, Any]
    seconds: float | None


@dataclass(frozen=True)
class PredictedViews:
    """A folder with a file per predicted view, each whole or not there."""

    path: Path

    @classmethod
    def open(cls, path: Path, key: Mapping[str, Any]) -> PredictedViews:
        """Open the folder at ``path``, emptied if it was made for another ``key``: what decides the predictions.

        Raises ``InputError`` where it cannot be written.
        """
        wanted = json.dumps(key, sort_keys=True)
        try:
            if (path / _KEY).is_file() and (path / _KEY).read_text() == wanted:
                return cls(path)
            shutil.rmtree(path, ignore_errors=True)
            path.mkdir(parents=True)
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror}") from None
        write_text(path / _KEY, wanted)
        return cls(path)

    def __len__(self) -> int:
        return sum(1 for _ in self.path.glob("*/*.npz"))

    def __contains__(self, view_id: str) -> bool:
        return self._file(view_id).is_file()

    def put(self, view_id: str, depth_m: Float[ndarray, "h w"], seconds: float) -> None:
        """Keep a view's depth and how long it took."""
        with replacing(self._file(view_id)) as temporary, temporary.open("wb") as stream:
            np.savez(stream, depth_m=depth_m, seconds=seconds)

    def get(self, view_id: str) -> tuple[Float[ndarray, "h w"], float]:
        """Return a kept view's depth and seconds."""
        with np.load(self._file(view_id), allow_pickle=False) as kept:
            return kept["depth_m"], float(kept["seconds"])

    def work(self, config: str) -> Path:
        """Return a config's folder for what a method keeps between interruptions, made if it is not there."""
        folder = self.path / f"{config}.work"
        folder.mkdir(exist_ok=True)
        return folder

    def put_preparation(self, config: str, preparation: Preparation) -> None:
        """Keep what preparing a config found."""
        write_text(self._preparation(config), json.dumps(vars(preparation)))

    def get_preparation(self, config: str) -> Preparation | None:
        """Return what preparing a config found, None where it never came to an end."""
        path = self._preparation(config)
        return Preparation(**json.loads(path.read_text())) if path.is_file() else None

    def _file(self, view_id: str) -> Path:
        return self.path / f"{view_id}.npz"

    def _preparation(self, config: str) -> Path:
        return self.path / f"{config}.json"


def predict(
    method: AnyMethod,
    root: str | Path,
    archive: str | Path,
    *,
    configs: Sequence[str] | None = None,
    progress: Progress = silent,
) -> dict[str, Preparation]:
    """Predict every view of the named configs (default: all) and write the archive, whole or not at all.

    Each view is kept beside the archive until all are there: after an interruption the same call predicts the
    missing ones only. ``submission.json`` records the seconds each view took, and of a method that sees all views
    of a config at once its notes on each, which are returned too.

    Raises ``DatasetError`` for an unknown folder or config, ``MethodError`` for what the method lacks or returns.
    """
    folder = open_folder(root)
    names = tuple(dict.fromkeys(configs or folder.configs))
    totals = {name: len(folder.views(name)) for name in names}
    target = Path(archive)
    key = {
        "method": vars(method.info),
        "dataset": {name: [folder.config(name)[of] for of in ("key", "ground_truth_digest")] for name in names},
        "software": software_version(),
    }
    if isinstance(method, MultiViewMethod):
        for name in names:
            with _told(f"{method.info.name}: {name}: check"):
                method.check(ConfigViews(folder, name))
    loaded = _loaded(method) if isinstance(method, Method) else None  # before anything is written
    views = PredictedViews.open(target.with_name(f".{target.name}.views"), key)
    if len(views):
        print(f"going on: {len(views)} views are in {views.path}; delete it to start over", file=sys.stderr)
    for name in names:
        done = [view.view_id for view in folder.views(name) if view.view_id in views]
        if len(done) == totals[name]:
            continue
        run = loaded or _prepared(method, ConfigViews(folder, name), views, progress)
        for count, row in enumerate(_missing(method, folder, name, set(done)), start=len(done) + 1):
            start = time.perf_counter()
            with _told(f"{method.info.name}: {row['view_id']}: the predictor, given {', '.join(row)}"):
                found = run(row)
            depth_m = _checked(method, row["view_id"], found, folder.grid(name))
            views.put(row["view_id"], depth_m, time.perf_counter() - start)
            progress(f"{method.info.name} on {name}", count, totals[name])
    prepared = {name: kept for name in names if (kept := views.get_preparation(name))}
    _write(method, target, views, [view.view_id for name in names for view in folder.views(name)], prepared)
    shutil.rmtree(views.path)
    return prepared


def _loaded(method: Method) -> Predictor:
    with _told(f"{method.info.name}: load"):
        run = method.load()
    if not callable(run):
        raise MethodError(f"{method.info.name}: load returned {type(run).__name__}, expected a function of a row")
    return run


@contextmanager
def _told(what: str) -> Iterator[None]:
    """Turn what a stranger's code raises in the block into a ``MethodError`` that says what, and where in it."""
    try:
        yield
    except RebarDepthError:
        raise
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{place.filename}:{place.lineno}"
        raise MethodError(f"{what}: raised {type(error).__name__}: {error} ({where})") from error


def _check_notes(method: AnyMethod, config: ConfigViews, prepared: Prepared) -> None:
    for key, value in prepared.notes.items():
        try:
            json.dumps({key: value}, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise MethodError(
                f"{method.info.name}: {config.config}: the note {key!r} is no plain JSON value: {error}"
            ) from None


def _prepared(method: AnyMethod, config: ConfigViews, views: PredictedViews, progress: Progress) -> Predictor:
    """Have a method look at all views of a config, and keep its notes."""
    assert isinstance(method, MultiViewMethod)
    work = views.work(config.config)
    afresh = not any(work.iterdir())
    start = time.perf_counter()
    with _told(f"{method.info.name}: {config.config}: prepare"):
        prepared = method.prepare(config, work, progress)
    if not isinstance(prepared, Prepared):
        raise MethodError(f"{method.info.name}: prepare returned {type(prepared).__name__}, expected a Prepared")
    _check_notes(method, config, prepared)
    if views.get_preparation(config.config) is None:
        seconds = round(time.perf_counter() - start, 1)
        views.put_preparation(config.config, Preparation(prepared.notes, seconds if afresh else None))
    return prepared.predict


def _missing(method: AnyMethod, folder: DatasetFolder, config: str, done: set[str]) -> Iterator[dict[str, Any]]:
    """Yield the rows of the views that are not done; the others are passed over undecoded."""
    columns = ("view_id", *method.info.columns)
    for row in load_undecoded(folder.root, config, streaming=True, columns=columns):
        if row["view_id"] not in done:
            yield decode_row(row)


def _checked(method: AnyMethod, view_id: str, depth_m: object, grid: tuple[int, int]) -> Float[ndarray, "h w"]:
    array = np.asarray(depth_m)
    if array.shape != grid or array.dtype.kind != "f":
        raise MethodError(
            f"{method.info.name}: {view_id}: the method returned {array.dtype} of shape {array.shape}, expected "
            f"float metres of shape {grid}"
        )
    return array


def _write(
    method: AnyMethod,
    archive: Path,
    views: PredictedViews,
    view_ids: Sequence[str],
    prepared: dict[str, Preparation],
) -> None:
    info = method.info
    runtime: dict[str, Any] = {
        "unit": "seconds",
        "python": platform.python_version(),
        "machine": platform.machine(),
    }
    if prepared:
        runtime["preparing"] = {config: found.seconds for config, found in prepared.items()}
    with SubmissionWriter(
        archive,
        method=info.name,
        description=info.summary,
        uses_intrinsics=info.uses_intrinsics,
        runtime=runtime,
        notes={config: found.notes for config, found in prepared.items()} or None,
    ) as writer:
        for view_id in view_ids:
            depth_m, seconds = views.get(view_id)
            writer.add(view_id, depth_m, round(seconds, 4))
