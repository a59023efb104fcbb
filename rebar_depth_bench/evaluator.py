"""Evaluation of a model in Python: each view is scored as it arrives.

For complete configs, ``rebar-bench score`` gives exactly the same numbers for an archive of the predictions.
"""

from __future__ import annotations

import os
import tempfile
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from rebar_depth_bench.base.errors import InputError, RebarDepthError, escape_text
from rebar_depth_bench.base.names import TEST_SPLIT, config_of
from rebar_depth_bench.base.terminal import ProgressBars
from rebar_depth_bench.base.writing import is_stream
from rebar_depth_bench.data.files import file_sha256
from rebar_depth_bench.data.loading import load
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.rows import POSE_COLUMNS, TRUTH_COLUMNS, ConfigViews, iterate_rows
from rebar_depth_bench.data.schema import COLUMNS
from rebar_depth_bench.diagnosis.corrections import KeptPredictions
from rebar_depth_bench.geometry.cameras import right_from_left
from rebar_depth_bench.methods import AnyMethod
from rebar_depth_bench.methods.base import input_class
from rebar_depth_bench.methods.registry import find_method
from rebar_depth_bench.methods.run import dataset_views, predict_views, wrap_errors
from rebar_depth_bench.scorer import (
    ScoredResult,
    ScoringTruth,
    ViewResult,
    file_stat,
    score,
    score_view,
    scored_result,
    tabulate_config,
)
from rebar_depth_bench.scoring.result import SubmissionIdentity
from rebar_depth_bench.submission import SubmissionReader, SubmissionWriter
from rebar_depth_bench.submission.declaration import METADATA_NAME, METRIC, Declaration
from rebar_depth_bench.submission.writer import depth_map, stored_map

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
    archive: str | os.PathLike[str] | None = None,
) -> ScoredResult:
    """Predict views of a dataset folder or Hub repository with a model, and score the predictions.

    ``model`` is the name of a method ("sgbm", "my.toml"), which then declares itself; a function from a row to the
    planar depth of the left view in metres, H x W; a mapping of view ids to depth; or an iterable of pairs of
    both. Depth is as for ``Evaluator.update``; of pairs, views that ``views`` does not select are passed over. A
    row has ``view_id``, colour, ``K`` and distortion of both eyes, ``baseline_m`` and ``right_from_left``, which
    takes points of the left camera's frame to the right one's; with ``inputs="multi-view"``, which then needs
    ``uses_ground_truth=True``, also the poses in the world. What the config lacks is None.

    The other arguments, and the errors, are documented at ``Evaluator``. An exception of a function is the cause
    of a ``MethodError``, which names the view and the line. Progress is shown for methods and functions.
    """
    selected: dict[str, Any] = {"config": config, "split": split, "views": views, "extended": extended}
    declared: dict[str, Any] = {
        "method": method,
        "kind": kind,
        "inputs": inputs,
        "uses_ground_truth": uses_ground_truth,
    }
    if isinstance(model, str):
        found_method = find_method(model)
        if given := [name for name, value in declared.items() if value != _UNDECLARED[name]]:
            named = f"{' and '.join(given)} {'is' if len(given) == 1 else 'are'} given"
            remedy = "; score its archive by score(ARCHIVE, ROOT, align=KIND)" if "kind" in given else ""
            raise InputError(f"{named}, but the method {model} declares its own{remedy}")
        return _evaluate_method(found_method, root, selected, archive)
    if callable(model) and inputs == "multi-view" and uses_ground_truth is not True:
        found = f"inputs is multi-view and uses_ground_truth is {uses_ground_truth}"
        raise InputError(f"{found}, expected True, because the rows then have the true poses")
    evaluator = Evaluator(root, **selected, **declared, archive=archive)
    try:
        if callable(model):
            what = "the model"
            if hasattr(model, "forward"):
                what += (
                    f", a {type(model).__name__} that is given a row; wrap it in a function, as {_WRAPPED_MODULE}"
                )
            with ProgressBars() as bars:
                for done, row in enumerate(evaluator._rows(with_poses=inputs == "multi-view"), 1):
                    with wrap_errors(f"{row['view_id']}: {what}"):
                        predicted = model(row)
                    evaluator._add(row["view_id"], predicted, "the model returned")
                    bars.update(f"evaluating {method}", done, len(evaluator.view_ids))
        else:
            for view_id, depth in _pairs(model):
                if view_id not in evaluator._left_out:
                    evaluator._add(view_id, depth)
        return evaluator.compute()
    except BaseException:
        evaluator.reset()  # An exception that is kept would keep an archive that is not complete.
        raise


def _evaluate_method(
    method: AnyMethod, root: str | Path, selected: Mapping[str, Any], archive: str | os.PathLike[str] | None
) -> ScoredResult:
    """Return the result of a method, whose predictions are in a temporary archive if none is named."""
    info = method.info
    if selected["extended"] and info.prediction != METRIC:
        raise InputError(f"{info.name} predicts {info.prediction}, but extended measures need metric depth")
    evaluator = Evaluator(
        root,
        **selected,
        method=info.name,
        kind=info.prediction,
        inputs=input_class(method),
        uses_ground_truth=info.uses_ground_truth,
    )
    with tempfile.TemporaryDirectory(prefix="rebar-evaluate-") as folder, ProgressBars() as bars:
        path = Path(folder, "predictions.zip") if archive is None else Path(archive)
        predict_views(method, evaluator._views, path, bars.update)
        if archive is not None:
            return score(path, evaluator._folder, extended=selected["extended"], progress=bars.update)
        with SubmissionReader(path, evaluator._grids) as submission:
            for view_id in evaluator.view_ids:
                evaluator._add(view_id, submission.read(view_id))
    return evaluator.compute()


class Evaluator:
    """Evaluation of predictions, each of which is scored when it is added; ``reset`` begins again.

    ``config`` is one config, or None for all that have the ``split``. ``views`` selects views of each config: a
    number of them, spread evenly, or their ids; such a result is not ranked. ``extended`` adds the extended
    measures. ``method``, ``inputs`` and ``uses_ground_truth`` are what the predictions declare, and ``kind`` is
    one of ``PREDICTION_KINDS``. With ``archive``, the predictions are also written to a submission archive, which
    replaces a file of this name once it is complete.

    Several threads may add views. A copy is independent of the evaluator, and so is the evaluator of a forked
    process; with ``archive``, it cannot be copied, and only the process that made it can add views.

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
        archive: str | os.PathLike[str] | None = None,
    ) -> None:
        if extended and kind != METRIC:
            raise InputError(f"extended is true and kind is {kind}, expected {METRIC} for measures in metres")
        if not isinstance(config, str | None):
            raise InputError(f"config is {escape_text(str(config))}, expected the name of one, or None for all")
        self._metadata: dict[str, Any] = {
            "method": method,
            "prediction": kind,
            "inputs": inputs,
            "uses_ground_truth": uses_ground_truth,
        }
        self._root, self._split, self._kind = root, split, kind
        self._archive, self._process = None if archive is None else Path(archive), os.getpid()
        if self._archive is not None and is_stream(self._archive):
            raise InputError(f"archive is {self._archive}, a device or a pipe, expected the name of a file")
        try:
            SubmissionWriter(self._archive or "predictions", **self._metadata)
        except InputError as error:
            argument = {f"{METADATA_NAME}: {name}": name for name in self._metadata}
            argument[f"{METADATA_NAME}: prediction"] = "kind"
            problems = [replace(one, where=argument.get(one.where, one.where)) for one in error.problems]
            raise InputError.from_problems("arguments", problems) from None
        whole = open_folder(root)
        self._all = dataset_views(whole, None if config is None else [config], split)
        self._views = self._all if views is None else _selected(self._all, views)
        self._folder = whole.model_copy(
            update={"config_by_name": {one.source.name: one.source for one in self._views}}
        )
        self._grids = self._folder.expected_views()
        self._left_out = {view_id for one in self._all for view_id in one.view_ids} - self._grids.keys()
        self._truths = {
            one.source.name: ScoringTruth.of(self._folder, one.source, extended=extended) for one in self._views
        }
        scored_at = {
            view_id: position
            for truth in self._truths.values()
            for position, view_id in enumerate(truth.scored.view_ids)
        }
        self._places = {
            view_id: (one.source.name, position, scored_at.get(view_id))
            for one in self._views
            for position, view_id in enumerate(one.source.view_ids)
        }
        """Config of each view, its position there, and that among the scored views, None without scored pixels."""
        self._lock = Lock()
        self._writer: SubmissionWriter | None = None
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
        """Drop all predictions, and an archive that is not complete."""
        if self._writer is not None:
            _discard(self._writer, self._process)
        self._writer = None
        self._sha256: str | None = None
        self._stat: tuple[int, ...] = ()
        self._scored: dict[str, ViewResult | None] = {}
        """Result of each view that was added; None for a view without scored pixels."""
        self._kept = {}
        if self._archive is None:
            self._kept = {
                name: KeptPredictions.of_truth(truth.config, truth.scored) for name, truth in self._truths.items()
            }

    def update(self, view_ids: str | Sequence[str], depth: object) -> None:
        """Add the planar depth of left views in metres, or of another kind: of one view or of a batch.

        ``depth`` is an array or tensor of any float type and device: H x W for one id, alone or in a list, also
        after axes of length 1; for a list of B ids B x H x W, B x 1 x H x W, or a list. Values that are
        not finite, and of ``metric`` and ``scale`` those <= 0, mean no prediction.

        Raises ``InputError``, which names the view, for one that is not to be predicted or was added before, and
        for depth of another size; the views before it in a batch stay added.
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
        stored = stored_map(depth_map(f"{view_id}: {what}", depth, self._grids[view_id]))
        name, position, scored_at = self._places[view_id]
        result = None
        if scored_at is not None and view_id not in self._scored:
            result = score_view(stored, self._truths[name], scored_at, self._kind, self._kind)
        with self._lock:
            if view_id in self._scored:
                sampler = "a distributed sampler repeats views to fill its last batch: gather all in one process"
                remedy = f"{sampler} and drop the repeated ones; reset() begins again"
                raise InputError(f"{view_id}: was added before, expected each view once; {remedy}")
            if self._archive is None:
                self._kept[name].add(position, stored)
            else:
                self._write(self._archive, view_id, stored)
            self._scored[view_id] = result

    def _write(self, archive: Path, view_id: str, stored: Depth) -> None:
        """Write a prediction to the archive, which is discarded with all predictions if that fails."""
        self._check_process(archive)
        if self._writer is None:
            writer = SubmissionWriter(archive, **self._metadata).__enter__()
            weakref.finalize(self, _discard, writer, self._process)
            self._writer = writer
        try:
            self._writer.write_map(view_id, stored)
        except BaseException:
            self.reset()
            raise

    def _check_process(self, archive: Path) -> None:
        """Raise ``RebarDepthError`` in a process that was forked from the one that writes the archive."""
        if os.getpid() != self._process:
            found = f"{archive}: is written by the process {self._process}"
            raise RebarDepthError(
                f"{found}, expected all views there; a forked process may evaluate without archive="
            )

    def compute(self) -> ScoredResult:
        """Return the result of the predictions; it may be called again until ``reset``.

        Raises ``InputError`` if a view is missing.
        """
        if missing := [view_id for view_id in self._grids if view_id not in self._scored]:
            found = f"{len(missing)} of {len(self._grids)} views are missing, such as {missing[0]}"
            given = {config_of(view_id) for view_id in self._scored}
            absent = [one.source.name for one in self._views if one.source.name not in given]
            if given and absent:
                found += f"; none is of {', '.join(absent)}: config={min(given)!r} evaluates that config alone"
            remedy = "views=... selects some, and reset() begins again; Lightning: Trainer(num_sanity_val_steps=0)"
            raise InputError(f"{found}, expected all of them before compute(): {remedy}")
        declared = Declaration(self._metadata["inputs"], self._metadata["uses_ground_truth"])
        scored = {}
        for name, truth in self._truths.items():
            views = [view for view_id in truth.scored.view_ids if (view := self._scored[view_id]) is not None]
            scored[name] = tabulate_config(views, truth, self._kind, declared)
        if self._archive is not None and self._sha256 is None:
            self._check_process(self._archive)
            assert self._writer is not None
            self._writer.__exit__(None, None, None)
            self._writer = None
            self._stat = file_stat(self._archive)
            self._sha256 = file_sha256(self._archive)
        return scored_result(
            scored,
            self._folder,
            SubmissionIdentity(
                self._metadata["method"], self._sha256, declared.inputs, declared.uses_ground_truth
            ),
            self._kind,
            self._kind,
            archive=None if self._archive is None else self._archive.absolute(),
            archive_stat=self._stat,
            kept=self._kept,
        )

    def _rows(self, *, with_poses: bool) -> Iterator[dict[str, Any]]:
        """Yield what a function may read of each view."""
        for views in self._views:
            for row in iterate_rows(views.source, _ROW_COLUMNS):
                row["right_from_left"] = None if row["right_cam_from_world"] is None else right_from_left(row)
                yield {name: value for name, value in row.items() if with_poses or name not in POSE_COLUMNS}

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """Return an evaluator with the same predictions, which shares the ground truth with this one.

        Raises ``RebarDepthError`` if an archive is written.
        """
        if self._archive is not None:
            found = f"the evaluator writes the archive {self._archive}"
            raise RebarDepthError(f"{found}, expected one without archive= to copy")
        twin = type(self).__new__(type(self))
        with self._lock:
            twin.__dict__.update(self.__dict__)
            twin._scored = dict(self._scored)
            twin._kept = {
                name: replace(kept, images=dict(kept.images), by_order=dict(kept.by_order))
                for name, kept in self._kept.items()
            }
        twin._lock = Lock()
        return twin

    def __copy__(self) -> Self:
        """Return a deep copy: a shallow one would share its predictions."""
        return self.__deepcopy__({})


def _discard(writer: SubmissionWriter, process: int) -> None:
    """Delete an archive that is not complete, unless another process writes it."""
    if os.getpid() == process:
        writer.discard()


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
