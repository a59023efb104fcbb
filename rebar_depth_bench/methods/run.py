"""Prediction runs: apply a method to views and write the submission archive.

Predictions are stored view by view in a folder beside the archive, so that an interrupted run is resumed and loses
at most one view.
"""

from __future__ import annotations

import json
import platform
import time
import traceback
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from rebar_depth_bench import software_version
from rebar_depth_bench.base.errors import DatasetError, InputError, MethodError, RebarDepthError, escape_text
from rebar_depth_bench.base.names import TEST_SPLIT
from rebar_depth_bench.base.parallel import Progress, silent
from rebar_depth_bench.base.reading import path_below, remove_folder
from rebar_depth_bench.base.writing import NO_SPACE, is_stream, link_target, scratch_folder, write_error
from rebar_depth_bench.data.manifest import DatasetFolder, open_folder
from rebar_depth_bench.data.rows import TRUTH_COLUMNS, Views
from rebar_depth_bench.methods import AnyMethod, ConfigViews, Method, MultiViewMethod, Predictor, Prepared
from rebar_depth_bench.methods.base import MethodInfo, import_optional, input_class
from rebar_depth_bench.methods.kept_views import KeptViews, PreparationReport
from rebar_depth_bench.methods.sgbm import RECTIFIED_COLUMNS, STEREO_COLUMNS, pair_row
from rebar_depth_bench.methods.view_files import CLOUD_COLUMNS, write_depth_picture, write_point_cloud
from rebar_depth_bench.submission import SubmissionWriter
from rebar_depth_bench.submission.declaration import METRIC
from rebar_depth_bench.submission.writer import depth_map, stored_map


def predict(
    method: AnyMethod,
    root: str | Path,
    archive: str | Path,
    *,
    configs: Sequence[str] | None = None,
    split: str = TEST_SPLIT,
    expect_digest: str | None = None,
    progress: Progress = silent,
) -> dict[str, PreparationReport]:
    """Predict a split of the named configs of a dataset (default: all that have it) with ``predict_views``.

    Raises ``DatasetError`` for an unknown folder, config or split or another digest than ``expect_digest``, and as
    ``predict_views``.
    """
    folder = open_folder(root, expect_digest=expect_digest)
    return predict_views(method, dataset_views(folder, configs, split), archive, progress)


def predict_views(
    method: AnyMethod,
    views: Sequence[Views],
    archive: str | Path,
    progress: Progress = silent,
    *,
    pictures: Path | None = None,
    clouds: Path | None = None,
) -> dict[str, PreparationReport]:
    """Predict all ``views``, and write the archive atomically.

    Each view is stored beside the archive until all are predicted: after an interruption, the same call predicts
    only the missing ones. ``submission.json`` records the seconds per view and the method's notes on each config.
    ``<view_id>.png`` of each view is written to the folder ``pictures`` (``write_depth_picture``), and
    ``<view_id>.ply`` to ``clouds`` (``write_point_cloud``), unless they are None; other files in them are kept.
    Returns the report of each scene that a multi-view method prepared, and of each config on which the method has
    notes, by ``Views.config``.

    Raises ``InputError`` if the views lack columns that the method or a point cloud needs, for point clouds of
    predictions that are not metric, if ``archive`` is a folder or the folder beside it holds anything but kept
    predictions, ``MethodError`` if the method cannot run or returns invalid values, and ``OutputError`` if the
    machine cannot write.
    """
    if clouds is not None and method.info.prediction != METRIC:
        raise InputError(
            f"{clouds}: {method.info.name} predicts the kind {method.info.prediction}, expected a method that "
            f"predicts {METRIC} depth: point clouds (--ply) are in metres; pictures (--pictures) are of any kind"
        )
    for config in views:
        config.check_columns(method.info.columns, method.info.name)
        if clouds is not None:
            config.check_columns(CLOUD_COLUMNS, "a point cloud (--ply)")
    target = Path(archive)
    if target.is_dir():
        raise InputError(f"{target}: is a folder, expected the name of the archive to write")
    if isinstance(method, MultiViewMethod):
        scenes = [scene for config in views for scene in config.by_scene()]
        # A capture has no ground truth.
        views = [
            _DeclaredViews(one.source, method.info) if isinstance(one, ConfigViews) else one for one in scenes
        ]
        for config in views:
            with wrap_errors(f"{method.info.name}: {config.config}: check"):
                method.check(config)
    # Loading comes first so that its errors occur before anything is written.
    loaded = _load_method(method) if isinstance(method, Method) else None
    noted = {config.config: report for config in views if (report := _first_row_report(method, config))}
    key = {
        "method": vars(method.info),
        "dataset": {config.config: config.identity for config in views},
        "software": software_version(),
    }
    with _kept_views_folder(target) as folder:
        kept = KeptViews.open(folder, key)
        usable = kept.usable(views)
        for config in views:
            done = usable & set(config.view_ids)
            if len(done) == len(config.view_ids) and (loaded is not None or config.config in kept.run.reports):
                continue
            predictor = _prepare_method(method, config, kept, progress) if loaded is None else loaded
            _predict_config(method, predictor, config, kept, done, progress)
        reports = noted | kept.run.reports
        _write_archive(method, target, kept, views, reports, pictures, clouds, progress)
        remove_folder(folder)
    return reports


@dataclass(frozen=True)
class _DeclaredViews(ConfigViews):
    """Views that raise ``MethodError`` where a method reads ground truth whose use it does not declare.

    The poses can be read: methods that compute their cameras report the errors of these.
    """

    info: MethodInfo

    @property
    def mesh(self) -> Path:
        """Path of the scene's mesh. Raises ``MethodError`` without the declaration."""
        self.info.check_truth(["mesh"], ["mesh"])
        return super().mesh

    def rows(self, *columns: str, skip: Collection[str] = ()) -> Iterator[dict[str, Any]]:
        """Yield rows as ``ConfigViews.rows``. Raises ``MethodError`` for ground truth without the declaration."""
        self.info.check_truth(columns, TRUTH_COLUMNS)
        return super().rows(*columns, skip=skip)


@contextmanager
def _kept_views_folder(archive: Path) -> Iterator[Path]:
    """Yield the path for kept predictions: beside the archive, or a temporary one for a device or a pipe."""
    if is_stream(archive):
        with scratch_folder() as folder:
            yield folder / "views"
    else:
        target = link_target(archive)
        yield target.with_name(f".{target.name}.views")


def dataset_views(
    folder: DatasetFolder, names: Sequence[str] | None = None, split: str = TEST_SPLIT
) -> list[ConfigViews]:
    """Return the views of the named configs (default: all that have the split), restricted to a split.

    Raises ``DatasetError`` if there is no such config or split.
    """
    having_split = [name for name, config in folder.config_by_name.items() if split in config.splits]
    chosen = [ConfigViews(folder.config(name).of_split(split)) for name in dict.fromkeys(names or having_split)]
    if not chosen:
        raise DatasetError(f"{folder.root}: no config has the split {escape_text(str(split))}")
    return chosen


def _predict_config(
    method: AnyMethod,
    predictor: Predictor,
    views: Views,
    kept: KeptViews,
    done: set[str],
    progress: Progress,
) -> None:
    """Predict and store the views that are not in ``done``."""
    columns = method.info.columns
    if views.rectify and isinstance(method, Method) and "left_distortion" not in columns:
        predictor, columns = rectifying_predictor(predictor, columns, method.info.prediction)
    for count, row in enumerate(views.rows(*columns, skip=done), start=len(done) + 1):
        start = time.perf_counter()
        with wrap_errors(f"{method.info.name}: {row['view_id']}: the predictor, given {', '.join(row)}"):
            prediction = predictor(row)
        what = f"{method.info.name}: {row['view_id']}: the method returned"
        depth_m = depth_map(what, prediction, views.grid, MethodError)
        kept.put(row["view_id"], depth_m, time.perf_counter() - start)
        progress(f"{method.info.name} on {views.config}", count, len(views.view_ids))


def _load_method(method: Method) -> Predictor:
    """Return the predictor of a single-view method. Raises ``MethodError`` if ``load`` fails."""
    with wrap_errors(f"{method.info.name}: load"):
        predictor = method.load()
    if not callable(predictor):
        raise MethodError(
            f"{method.info.name}: load returned {type(predictor).__name__}, expected a function of a row"
        )
    return predictor


@contextmanager
def wrap_errors(what: str) -> Iterator[None]:
    """Convert exceptions of a method's code into ``MethodError`` with ``what`` failed and the source line.

    Errors of this project (``RebarDepthError``) pass unchanged, and a full disk is no failure of the method.
    """
    try:
        yield
    except RebarDepthError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.errno in NO_SPACE:
            raise write_error(error.filename or f"{what}: a file of the method", error) from error
        frame = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{frame.filename}:{frame.lineno}"
        raise MethodError(f"{what}: raised {type(error).__name__}: {error} ({where})") from error


def _first_row_report(method: AnyMethod, views: Views) -> PreparationReport | None:
    """Return the report with a single-view method's notes on a config, None if it makes none."""
    if not isinstance(method, Method) or method.notes is None:
        return None
    row = next(views.rows(*method.info.columns))
    with wrap_errors(f"{method.info.name}: {views.config}: notes"):
        return PreparationReport(notes=_plain_notes(method, views.config, method.notes(row)), seconds=None)


def _plain_notes(method: AnyMethod, config: str, notes: Mapping[str, Any]) -> dict[str, Any]:
    """Return notes as they are read from JSON. Raises ``MethodError`` unless all are plain JSON values."""
    plain: dict[str, Any] = {}
    for key, value in notes.items():
        try:
            plain |= json.loads(json.dumps({key: value}, allow_nan=False))
        except (TypeError, ValueError) as error:
            raise MethodError(
                f"{method.info.name}: {config}: the note {key!r} is not a plain JSON value: {error}"
            ) from None
    return plain


def _prepare_method(method: AnyMethod, views: Views, kept: KeptViews, progress: Progress) -> Predictor:
    """Return the predictor of a multi-view method for a config, and store its report unless there is one."""
    assert isinstance(method, MultiViewMethod)
    work = kept.path_of(f"{views.config}.work")
    try:
        work.mkdir(exist_ok=True)
    except OSError as error:
        raise write_error(work, error) from None
    started_from_scratch = not any(work.iterdir())
    start = time.perf_counter()
    with wrap_errors(f"{method.info.name}: {views.config}: prepare"):
        prepared = method.prepare(views, work, progress)
    if not isinstance(prepared, Prepared):
        raise MethodError(f"{method.info.name}: prepare returned {type(prepared).__name__}, expected a Prepared")
    notes = _plain_notes(method, views.config, prepared.notes)
    if views.config not in kept.run.reports:
        seconds = round(time.perf_counter() - start, 1) if started_from_scratch else None
        kept.put_report(views.config, PreparationReport(notes=notes, seconds=seconds))
    return prepared.predict


def _write_archive(
    method: AnyMethod,
    archive: Path,
    kept: KeptViews,
    views: Sequence[Views],
    reports: dict[str, PreparationReport],
    pictures: Path | None,
    clouds: Path | None,
    progress: Progress,
) -> None:
    """Write the kept predictions of ``views`` into the archive, with runtimes and notes, and their files."""
    info = method.info
    runtime: dict[str, Any] = {
        "unit": "seconds",
        "python": platform.python_version(),
        "machine": platform.machine(),
    }
    if reports and isinstance(method, MultiViewMethod):
        runtime["preparing"] = {config: report.seconds for config, report in reports.items()}
    with SubmissionWriter(
        archive,
        method=info.name,
        description=info.summary,
        inputs=input_class(method),
        uses_ground_truth=info.uses_ground_truth,
        prediction=info.prediction,
        runtime=runtime,
        notes={config: report.notes for config, report in reports.items()} or None,
    ) as writer:
        for config in views:
            rows: Iterable[dict[str, Any]] = (
                repeat({}, len(config.view_ids)) if clouds is None else config.rows(*CLOUD_COLUMNS)
            )
            for count, (view_id, row) in enumerate(zip(config.view_ids, rows, strict=True), start=1):
                depth, seconds = kept.get(view_id, config.grid)
                writer.add(view_id, depth, round(seconds, 4))
                if pictures is not None:
                    path = path_below(pictures, f"{view_id}.png")
                    write_depth_picture(path, view_id, stored_map(depth), info.prediction)
                if clouds is not None:
                    write_point_cloud(path_below(clouds, f"{view_id}.ply"), stored_map(depth), row)
                progress(f"writing {config.config}", count, len(config.view_ids))


# Rectified images for methods that do not read the lens distortion, and their depth on the raw left grid.
#
# A method that reads the right image is given the rectified pair (``geometry.rectification``), another one the
# undistorted left image. Its depth is transferred to the raw left image without interpolation; values that are
# known up to a shift keep their value, although the raw camera is turned against the rectified one. Multi-view
# methods, and those that read ``left_distortion``, do this themselves.

_MONO_COLUMNS = ("left_rgb", "left_K", "left_distortion")


def rectifying_predictor(
    predictor: Predictor, columns: Sequence[str], kind: str = METRIC
) -> tuple[Predictor, tuple[str, ...]]:
    """Return a predictor of raw rows, and the columns that it needs, for a predictor of rectified rows.

    ``predictor`` reads ``columns``, and ``kind`` is the kind of its predictions. Raises ``MethodError`` if
    a rectified row lacks one of the columns, and if OpenCV is missing.
    """
    if others := sorted(set(columns) - RECTIFIED_COLUMNS):
        raise MethodError(
            f"the images are not rectified: the method needs {', '.join(others)}, expected columns among "
            f"{', '.join(sorted(RECTIFIED_COLUMNS))}, or left_distortion if it rectifies them itself"
        )
    rectification = import_optional(
        "rebar_depth_bench.geometry.rectification", "the images are not rectified, which needs OpenCV", "methods"
    )
    is_stereo = any(name.startswith("right_") or name == "baseline_m" for name in columns)

    def predict_raw(row: Mapping[str, Any]) -> Float[ndarray, "h w"]:
        if is_stereo:
            pair = rectification.rectified_pair(row)
            if kind.startswith("affine"):
                pair = replace(pair, depth_ratio=np.ones_like(pair.depth_ratio))
            cells, on_raw_grid = pair_row(pair), partial(rectification.raw_depth_m, pair)
        else:
            height, width, _ = row["left_rgb"].shape
            grid = rectification.pinhole_grid(row, width, height)
            cells = {"left_rgb": rectification.pinhole_image(row, grid), "left_K": grid.K}
            on_raw_grid = grid.depth_on_left_grid
        depth_m = predictor({"view_id": row["view_id"], **{name: cells[name] for name in columns}})
        what = f"{row['view_id']}, rectified: the method returned"
        return np.asarray(on_raw_grid(depth_map(what, depth_m, cells["left_rgb"].shape[:2], MethodError)))

    return predict_raw, STEREO_COLUMNS if is_stereo else _MONO_COLUMNS
