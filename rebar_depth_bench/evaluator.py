"""Scoring in Python, of an archive or of a model, whose predictions are collected in a temporary archive.

For complete configs the result is that of ``rebar-bench score`` on the same archive, to the byte.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from rebar_depth_bench.base.errors import InputError, RebarDepthError, escape_text
from rebar_depth_bench.base.names import TEST_SPLIT, config_of
from rebar_depth_bench.base.parallel import Progress, silent
from rebar_depth_bench.base.writing import output_file
from rebar_depth_bench.data.loading import load
from rebar_depth_bench.data.manifest import DatasetFolder, open_folder
from rebar_depth_bench.data.rows import POSE_COLUMNS, TRUTH_COLUMNS, ConfigViews, iterate_rows
from rebar_depth_bench.data.schema import COLUMNS
from rebar_depth_bench.diagnosis.diagnose import diagnose
from rebar_depth_bench.geometry.cameras import right_from_left
from rebar_depth_bench.methods.registry import find_method
from rebar_depth_bench.methods.run import dataset_views, predict_views, wrap_errors
from rebar_depth_bench.reporting.html.page import write_report
from rebar_depth_bench.scoring.evaluation import Evaluation, open_evaluation, score_evaluation
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.scoring.truth import scored_counts
from rebar_depth_bench.submission import SubmissionWriter
from rebar_depth_bench.submission.declaration import METRIC
from rebar_depth_bench.submission.writer import depth_map

if TYPE_CHECKING:
    from datasets import Dataset

Depth = Float[ndarray, "h w"]
Model = str | Callable[[Mapping[str, Any]], object] | Mapping[str, object] | Iterable[tuple[str, object]]

_ROW_COLUMNS = tuple(name for name in COLUMNS if name != "scene" and name not in TRUTH_COLUMNS)
_UNDECLARED = {"method": "unnamed", "kind": METRIC, "inputs": None, "uses_ground_truth": None}
"""Defaults of what predictions declare."""
_WRAPPED_MODULE = 'lambda row: net(torch.tensor(row["left_rgb"]).permute(2, 0, 1)[None] / 255)'
"""Function of a row for a network that takes B x 3 x H x W."""


def evaluate(
    model: Model,
    root: str | Path,
    *,
    config: str | None = None,
    split: str = TEST_SPLIT,
    views: int | Sequence[str] | None = None,
    extended: bool = False,
    method: str = "unnamed",
    kind: str = "metric",
    inputs: str | None = None,
    uses_ground_truth: bool | None = None,
) -> EvaluatedResult:
    """Predict views of a dataset folder or Hub repository with a model, and score the predictions.

    ``model`` is the name of a method ("sgbm", "my.toml"), which then declares itself; a function from a row to the
    planar depth of the left view in metres, H x W; a mapping of view ids to depth; or an iterable of pairs of
    both. Depth is as for ``Evaluator.update``; of pairs, views that ``views`` does not select are passed over. A
    row has ``view_id``, colour, ``K`` and distortion of both eyes, ``baseline_m`` and ``right_from_left``, which
    takes points of the left camera's frame to the right one's; with ``inputs="multi-view"``, which then needs
    ``uses_ground_truth=True``, also the poses in the world. What the config lacks is None.

    The other arguments are those of ``Evaluator``, and so are the errors. An exception of a function is the cause
    of a ``MethodError``, which names the view and the line.
    """
    declared = dict[str, Any](method=method, kind=kind, inputs=inputs, uses_ground_truth=uses_ground_truth)
    evaluator = Evaluator(root, config, split=split, views=views, extended=extended, **declared)
    if isinstance(model, str):
        given = [name for name, value in declared.items() if value != _UNDECLARED[name]]
        if given:
            named = f"{' and '.join(given)} {'is' if len(given) == 1 else 'are'} given"
            remedy = "; score its archive by score(ARCHIVE, ROOT, align=KIND)" if "kind" in given else ""
            raise InputError(f"{named}, but the method {model} declares its own{remedy}")
        return evaluator._predicted_by(model)
    if callable(model):
        if inputs == "multi-view" and uses_ground_truth is not True:
            found = f"inputs is multi-view and uses_ground_truth is {uses_ground_truth}"
            raise InputError(f"{found}, expected True, because the rows then have the true poses")
        rows = evaluator._rows(with_poses=inputs == "multi-view")
        what = "the model"
        if hasattr(model, "forward"):
            what += f", a {type(model).__name__} that is given a row; wrap it in a function, as {_WRAPPED_MODULE}"
        for row in rows:
            with wrap_errors(f"{row['view_id']}: {what}"):
                predicted = model(row)
            evaluator._add(row["view_id"], predicted, "the model returned")
    else:
        for view_id, depth in _pairs(model):
            if view_id not in evaluator._left_out:
                evaluator._add(view_id, depth)
    return evaluator.compute()


def score(
    archive: str | os.PathLike[str],
    root: str | Path,
    *,
    workers: int | None = None,
    expect_digest: str | None = None,
    align: str | None = None,
    progress: Progress = silent,
) -> EvaluatedResult:
    """Score an archive against a dataset folder or Hub repository.

    An archive is scored by the kind of its predictions; ``align`` scores a metric one as one of another kind.

    Views are read directly from the archive and scored on ``workers`` threads (default: one per core); only a few
    views are in memory at a time. The result does not depend on the number of workers.

    Raises ``SubmissionError`` with all problems if any part of the archive is invalid, and ``DatasetError`` if the
    dataset folder is invalid or its digest is not ``expect_digest``.
    """
    with open_evaluation(archive, root, expect_digest=expect_digest) as evaluation:
        result = score_evaluation(evaluation, workers=workers, align=align, progress=progress)
        path = evaluation.submission.path.absolute()
        return EvaluatedResult(**vars(result), _archive=path, _folder=evaluation.folder)


class Evaluator:
    """Collector of predictions, which ``compute`` scores; ``reset`` begins again, as for the next epoch.

    ``config`` is one config, or None for all that have the ``split``. ``views`` selects views of each config: a
    number of them, spread evenly, or their ids; such a result is not ranked. ``extended`` adds the extended
    measures. ``method``, ``inputs`` and ``uses_ground_truth`` are what the predictions declare, and ``kind`` is
    one of ``PREDICTION_KINDS``.

    Raises ``DatasetError`` for an invalid dataset folder and an unknown config or split, and ``InputError`` for
    unknown views and invalid declarations.
    """

    def __init__(
        self,
        root: str | Path,
        config: str | None = None,
        *,
        split: str = TEST_SPLIT,
        views: int | Sequence[str] | None = None,
        extended: bool = False,
        method: str = "unnamed",
        kind: str = "metric",
        inputs: str | None = None,
        uses_ground_truth: bool | None = None,
    ) -> None:
        if extended and kind != METRIC:
            raise InputError(f"extended is true and kind is {kind}, expected {METRIC} for measures in metres")
        self._root, self._split, self._extended = root, split, extended
        self._declared: dict[str, Any] = {
            "method": method,
            "prediction": kind,
            "inputs": inputs,
            "uses_ground_truth": uses_ground_truth,
        }
        if not isinstance(config, str | None):
            raise InputError(f"config is {escape_text(str(config))}, expected the name of one, or None for all")
        whole = open_folder(root)
        self._all = dataset_views(whole, None if config is None else [config], split)
        self._views = self._all if views is None else _selected(self._all, views)
        self._folder = whole.model_copy(
            update={"config_by_name": {one.source.name: one.source for one in self._views}}
        )
        self._grids = self._folder.expected_views()
        self._left_out = {view_id for one in self._all for view_id in one.view_ids} - self._grids.keys()
        self.reset()

    @property
    def view_ids(self) -> tuple[str, ...]:
        """Ids of the views to predict, in order."""
        return tuple(self._grids)

    @cached_property
    def dataset(self) -> Dataset:
        """Rows of the views, as ``load`` returns them. Raises ``InputError`` for several configs."""
        if len(self._views) > 1:
            names = ", ".join(one.source.name for one in self._views)
            raise InputError(f"{self._root}: the configs are {names}, expected one: Evaluator(ROOT, CONFIG)")
        [views], [whole] = self._views, self._all
        rows = load(self._root, views.source.name, split=self._split)
        positions = {view_id: position for position, view_id in enumerate(whole.view_ids)}
        return rows.select([positions[view_id] for view_id in views.view_ids])

    def reset(self) -> None:
        """Drop all predictions."""
        self._archive = _TemporaryArchive()
        try:
            self._writer = SubmissionWriter(self._archive.path, **self._declared)
        except InputError as error:  # Its message names the temporary archive.
            raise InputError.from_problems("declaration", error.problems) from None
        self._added = set[str]()

    def update(self, view_ids: str | Sequence[str], depth: object) -> None:
        """Add the planar depth of left views in metres, or of another kind: of one view or of a batch.

        ``depth`` is an array or tensor of any float type and device: H x W for one id, alone or in a list, also
        after axes of length 1; for a list of B ids B x H x W, B x 1 x H x W, or a list. Values that are
        not finite, and of ``metric`` and ``scale`` those <= 0, mean no prediction.

        Raises ``InputError``, which names the view, for one that is not to be predicted or was added before, and
        for depth of another size.
        """
        if isinstance(view_ids, str):
            self._add(view_ids, depth)
            return
        if (
            not isinstance(view_ids, Iterable)
            or isinstance(view_ids, Mapping)
            or getattr(view_ids, "ndim", 1) == 0
        ):
            found = f"an object of type {type(view_ids).__name__}"
            raise InputError(f"view_ids is {found}, expected a view id or a list of them")
        ids = list(view_ids)
        axes = getattr(depth, "ndim", None)
        if isinstance(depth, Iterable) and not isinstance(depth, Mapping | str | bytes) and axes != 0:
            maps = [depth] if len(ids) == 1 and axes == 2 else list(depth)
        else:
            maps = [depth] * max(len(ids), 1)  # ``depth_map`` refuses it.
        if len(maps) != len(ids):
            shape = "" if axes is None else f" of shape {tuple(getattr(depth, 'shape', ()))}"
            found = f"{len(ids)} view ids and {len(maps)} depth maps ({type(depth).__name__}{shape}) are given"
            raise InputError(f"{found}, expected as many of both")
        for view_id, one in zip(ids, maps, strict=True):
            self._add(view_id, one)

    def _add(self, view_id: str, depth: object, what: str = "depth is") -> None:
        if not isinstance(view_id, str) or view_id not in self._grids:
            found = f"{escape_text(str(view_id))}: is not among the {len(self._grids)} views to predict"
            others = "config=, split= and views= select others"
            raise InputError(f"{found}, expected one as {next(iter(self._grids))}; {others}")
        if view_id in self._added:
            raise InputError(
                f"{view_id}: was added before, expected each view once; a distributed sampler repeats views to "
                "fill its last batch: gather all in one process and drop the repeated ones; reset() begins again"
            )
        one = depth_map(f"{view_id}: {what}", depth, self._grids[view_id])
        if not self._added:
            self._archive.writers.enter_context(self._writer)
        self._added.add(view_id)
        self._writer.write_map(view_id, one)

    def compute(self) -> EvaluatedResult:
        """Return the result of the predictions and begin again.

        Raises ``InputError`` if a view is missing, and as ``score`` does, after which all are missing.
        """
        if missing := [view_id for view_id in self._grids if view_id not in self._added]:
            found = f"{len(missing)} of {len(self._grids)} views are missing, such as {missing[0]}"
            given = {config_of(view_id) for view_id in self._added}
            absent = [one.source.name for one in self._views if one.source.name not in given]
            if given and absent:
                found += f"; none is of {', '.join(absent)}: config={min(given)!r} evaluates that config alone"
            remedy = "views=... selects some, and reset() begins again; Lightning: Trainer(num_sanity_val_steps=0)"
            raise InputError(f"{found}, expected all of them before compute(): {remedy}")
        self._archive.writers.close()
        return self._scored()

    def _scored(self) -> EvaluatedResult:
        partial = [one.source for one in self._views if one.source.whole is not one.source]
        archive = self._archive
        self.reset()
        with open_evaluation(archive.path, self._folder) as evaluation:
            if self._extended:
                from rebar_depth_bench.extended.registry import score_extended  # Other evaluations do not need it.

                result = score_extended(evaluation)
            else:
                result = score_evaluation(evaluation)
            some = {
                config.name: result.tables[config.name].of_some_views(len(scored_counts(config.whole)))
                for config in partial
            }
            result = replace(result, tables={**result.tables, **some})
            return EvaluatedResult(**vars(result), _archive=archive.path, _folder=self._folder, _owner=archive)

    def _predicted_by(self, name: str) -> EvaluatedResult:
        """Return the result of a method."""
        found = find_method(name)
        if self._extended and found.info.prediction != METRIC:
            raise InputError(f"{name} predicts {found.info.prediction}, but extended measures need metric depth")
        predict_views(found, self._views, self._archive.path)
        return self._scored()

    def _rows(self, *, with_poses: bool) -> Iterator[dict[str, Any]]:
        """Yield what a function may read of each view."""
        for views in self._views:
            for row in iterate_rows(views.source, _ROW_COLUMNS):
                row["right_from_left"] = None if row["right_cam_from_world"] is None else right_from_left(row)
                yield {name: value for name, value in row.items() if with_poses or name not in POSE_COLUMNS}


@dataclass(frozen=True, repr=False, kw_only=True)
class EvaluatedResult(Result):
    """Result of ``score`` or ``evaluate``, whose archive is read again for the notes and the report.

    The archive of ``evaluate`` is temporary and deleted with the result.
    """

    _archive: Path = field(compare=False)
    _folder: DatasetFolder = field(compare=False)
    _owner: _TemporaryArchive | None = field(default=None, compare=False)

    @cached_property
    def notes(self) -> tuple[str, ...]:
        """Sentences on what limits the numbers, and on possible mistakes in the predictions.

        Mistakes are looked for when this is read first; if the archive has gone or changed, a sentence says so.
        """
        try:
            with self._evaluation() as evaluation:
                mistakes = [f"possible mistake: {mistake.text}" for mistake in diagnose(evaluation)]
        except RebarDepthError as error:
            mistakes = [f"possible mistakes were not looked for: {' '.join(str(error).split())}"]
        return (*super().notes, *mistakes)

    def to_html(self, path: str | Path) -> None:
        """Write the self-contained report of ``rebar-bench score --html``.

        Raises ``InputError`` if the archive has gone or changed.
        """
        with self._evaluation() as evaluation:
            write_report(self, evaluation, Path(path))

    def save_archive(self, path: str | Path) -> None:
        """Copy the archive of the predictions.

        Raises ``InputError`` if only some views were evaluated, and if the archive has gone or changed.
        """
        for name, table in self.tables.items():
            if table.of_views is not None:
                found = f"{name}: {table.views} of {table.of_views} views were evaluated"
                raise InputError(f"{found}, expected all views of a config in an archive")
        with self._evaluation() as evaluation, output_file(Path(path)) as target:
            shutil.copyfile(evaluation.submission.path, target)

    @contextmanager
    def _evaluation(self) -> Iterator[Evaluation]:
        with open_evaluation(self._archive, self._folder) as evaluation:
            found, expected = evaluation.submission.sha256(), self.submission.sha256
            if found != expected:
                found = (
                    f"has the SHA-256 {found[:12]}..., expected {expected[:12]}... of the archive that was scored"
                )
                raise InputError(f"{self._archive}: {found}; score it again")
            yield evaluation


class _TemporaryArchive:
    """Path of an archive in a temporary folder, deleted with this object after its ``writers`` are closed."""

    def __init__(self) -> None:
        folder = tempfile.mkdtemp(prefix="rebar-evaluate-")
        self.path = Path(folder, "predictions.zip")
        stack = ExitStack()
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        self.writers = stack.enter_context(ExitStack())
        weakref.finalize(self, stack.close)


def _selected(configs: Sequence[ConfigViews], views: int | Sequence[str]) -> list[ConfigViews]:
    """Return some views of each config: a number of them, spread evenly, or those with the given ids."""
    if not isinstance(views, Iterable) or getattr(views, "ndim", 1) == 0:
        if not isinstance(views, int | np.integer) or isinstance(views, bool) or views < 1:
            raise InputError(f"views is {views!r}, expected a whole number from 1 or view ids")
        spread = [
            [one.view_ids[k * len(one.view_ids) // views] for k in range(views)]
            if views < len(one.view_ids)
            else one.view_ids
            for one in configs
        ]
    else:
        known = {view_id for one in configs for view_id in one.view_ids}
        views = [views] if isinstance(views, str) else list(views)
        if not views:
            raise InputError(f"views has no id, expected a number from 1 or ids of views, as {min(known)}")
        if unknown := [view_id for view_id in views if not isinstance(view_id, str) or view_id not in known]:
            raise InputError(f"views has {escape_text(str(unknown[0]))}, expected ids of views, as {min(known)}")
        wanted = set(views)
        spread = [[view_id for view_id in one.view_ids if view_id in wanted] for one in configs]
    return [
        one if len(ids) == len(one.view_ids) else ConfigViews(one.source.of_views(ids))
        for one, ids in zip(configs, spread, strict=True)
        if ids
    ]


def _pairs(model: object) -> Iterator[tuple[str, object]]:
    """Yield ids and depth of a mapping or of pairs. Raises ``InputError`` for anything else."""
    pairs = model.items() if isinstance(model, Mapping) else model
    for pair in pairs if isinstance(pairs, Iterable) else [None]:
        if not (isinstance(pair, tuple) and len(pair) == 2 and isinstance(pair[0], str)):
            expected = "the name of a method, a function of a row, or view ids with their depth"
            raise InputError(f"the model is of type {type(model).__name__}, expected {expected}")
        yield pair
