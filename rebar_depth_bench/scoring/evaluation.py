"""Scoring of a submission archive against a dataset folder: both are open in an ``Evaluation``.

``score`` opens them and passes their views to the arithmetic of ``scoring.score``, on several threads.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from rebar_depth_bench import software_version
from rebar_depth_bench.data.manifest import DatasetConfig, DatasetFolder, open_folder
from rebar_depth_bench.data.rows import CAMERA_KINDS, RowDecoder, camera_from_row, iterate_undecoded
from rebar_depth_bench.data.shards import rows_at
from rebar_depth_bench.errors import Problem, SubmissionError
from rebar_depth_bench.geometry.cameras import Camera
from rebar_depth_bench.names import TEST_SPLIT, config_of, split_of
from rebar_depth_bench.parallel import Progress, map_with_progress, silent
from rebar_depth_bench.scoring.protocol import PROTOCOL
from rebar_depth_bench.scoring.result import DatasetIdentity, Result, SoftwareIdentity, SubmissionIdentity
from rebar_depth_bench.scoring.score import ReadDepth, UseView, score_views
from rebar_depth_bench.scoring.table import ViewScore
from rebar_depth_bench.scoring.truth import config_truth
from rebar_depth_bench.submission import Declaration, EntryError, SubmissionReader, open_submission
from rebar_depth_bench.submission.declaration import NOT_DECLARED
from rebar_depth_bench.submission.maps import Depth

_Found = TypeVar("_Found")


@dataclass(frozen=True)
class ArchiveIdentity:
    """Method name of an archive and the hex SHA-256 of its file."""

    method: str
    sha256: str


@dataclass(frozen=True)
class Provenance:
    """Provenance of the numbers of a comparison, or of an analysis of archives.

    ``protocol`` names the definitions of the numbers; changed definitions have a new name. ``dataset_digest`` and
    ``dataset_version`` are None if the reference is not a dataset folder.
    """

    protocol: str
    dataset_digest: str | None
    dataset_version: str | None
    archives: Sequence[ArchiveIdentity]

    def to_dict(self) -> dict[str, Any]:
        """Return the provenance entries of a JSON object."""
        dataset = {"digest": self.dataset_digest, "version": self.dataset_version}
        return {
            "protocol": self.protocol,
            "dataset": dataset if self.dataset_digest is not None else None,
            "submissions": [{"method": archive.method, "sha256": archive.sha256} for archive in self.archives],
            "software": {"version": software_version()},
        }


@dataclass(frozen=True, eq=False)
class View:
    """View of a submission, for diagnosis and pictures: cells and prediction are decoded once, on first use.

    ``position`` counts the views of the config, ``encoded`` is the row, and ``read_depth`` reads predictions.
    """

    config: DatasetConfig
    position: int
    encoded: Mapping[str, Any]
    read_depth: ReadDepth
    _decoded: dict[str, Any] = field(default_factory=dict)

    @property
    def view_id(self) -> str:
        """Id of the view."""
        return self.config.view_ids[self.position]

    @cached_property
    def prediction_m(self) -> Float[ndarray, "h w"]:
        """Submitted planar depth in metres, H x W. Raises ``EntryError`` for an invalid entry."""
        return self.read_depth(self.view_id)

    def cell(self, column: str) -> Any:
        """Return the decoded cell of a column. Raises ``DatasetError`` if it is damaged."""
        if column not in self._decoded:
            row = {"view_id": self.view_id, column: self.encoded[column]}
            self._decoded[column] = RowDecoder.of(self.config).row(row)[column]
        return self._decoded[column]

    def camera(self, eye: str) -> Camera:
        """Return the camera of one eye."""
        cells = {f"{eye}_{kind}": self.cell(f"{eye}_{kind}") for kind in CAMERA_KINDS}
        return camera_from_row(cells, eye, self.config.grid)


def read_views(
    config: DatasetConfig, columns: Sequence[str], positions: Collection[int], read_depth: ReadDepth
) -> Iterator[View]:
    """Yield the views at ``positions`` of a config, one at a time; only their rows are read.

    Raises ``DatasetError`` for a damaged shard.
    """
    remaining = {config.view_ids[position]: position for position in sorted(positions)}
    for row in rows_at(config, ("view_id", *columns), list(remaining.values())):
        if (position := remaining.pop(row["view_id"], None)) is not None:
            yield View(config, position, row, read_depth)
    if remaining:  # The rows are in another order than in the manifest.
        for row in iterate_undecoded(config, ("view_id", *columns)):
            if (position := remaining.pop(row["view_id"], None)) is not None:
                yield View(config, position, row, read_depth)


@dataclass(frozen=True)
class Evaluation:
    """Submission whose structure is valid, and the dataset folder it is evaluated against."""

    folder: DatasetFolder
    submission: SubmissionReader
    _made: dict[object, Any] = field(default_factory=dict, repr=False, compare=False)

    @property
    def method(self) -> str:
        """Name of the method."""
        return self.submission.meta.method if self.submission.meta else ""

    @property
    def declared(self) -> Declaration:
        """What the submission declares about its inputs and its use of ground truth."""
        return self.submission.meta.declaration if self.submission.meta else NOT_DECLARED

    @cached_property
    def configs(self) -> tuple[DatasetConfig, ...]:
        """Configs that the submission contains, in the order of the folder, each restricted to its split."""
        split_by_config = {config_of(view_id): split_of(view_id) for view_id in self.submission.view_ids}
        return tuple(
            config.of_split(split_by_config[name] or TEST_SPLIT) if config.has_splits else config
            for name, config in self.folder.config_by_name.items()
            if name in split_by_config
        )

    def once(self, key: object, make: Callable[[], _Found]) -> _Found:
        """Return what ``make`` returned when this was called first with ``key``: what several measures need."""
        if key not in self._made:
            self._made[key] = make()
        found: _Found = self._made[key]
        return found

    def views(self, config: DatasetConfig, columns: Sequence[str], positions: Collection[int]) -> Iterator[View]:
        """Yield the views at ``positions`` of a config as ``read_views``."""
        return read_views(config, columns, positions, self.submission.read)

    def check_entries(self, progress: Progress = silent) -> None:
        """Decode every entry. Raises ``SubmissionError`` with all problems."""
        problems = list(self.submission.problems(progress))
        if problems:
            raise SubmissionError.from_problems(self.submission.path, problems)

    def provenance(self) -> Provenance:
        """Return the provenance of an analysis of the submission."""
        archives = (ArchiveIdentity(self.method, self.submission.sha256()),)
        return Provenance(PROTOCOL, self.folder.digest, self.folder.version, archives)


@contextmanager
def open_evaluation(
    archive: str | os.PathLike[str], root: str | Path, *, expect_digest: str | None = None
) -> Iterator[Evaluation]:
    """Open an archive and a dataset folder or Hub repository, and close the archive when the block ends.

    Raises ``SubmissionError`` with all problems, also those of single entries, if the structure of the archive is
    invalid, and ``DatasetError`` if the dataset folder is, or if its digest is not ``expect_digest``.
    """
    folder = open_folder(root, expect_digest=expect_digest)
    with open_submission(archive, folder.expected_views()) as submission:
        if submission.meta is None or submission.structure_problems:
            raise SubmissionError.from_problems(archive, list(submission.problems()))
        yield Evaluation(folder, submission)


def score(
    archive: str | os.PathLike[str],
    root: str | Path,
    *,
    workers: int | None = None,
    expect_digest: str | None = None,
    progress: Progress = silent,
) -> Result:
    """Score an archive against a dataset folder or Hub repository.

    Views are read directly from the archive and scored on ``workers`` threads (default: one per core); only a few
    views are in memory at a time. The result does not depend on the number of workers.

    Raises ``SubmissionError`` with all problems if any part of the archive is invalid, and ``DatasetError`` if the
    dataset folder is invalid or its digest is not ``expect_digest``.
    """
    with open_evaluation(archive, root, expect_digest=expect_digest) as evaluation:
        return score_evaluation(evaluation, workers=workers, progress=progress)


def score_evaluation(
    evaluation: Evaluation,
    *,
    workers: int | None = None,
    progress: Progress = silent,
    use_view: UseView | None = None,
) -> Result:
    """Score an open submission as ``score`` does; ``use_view`` is called on its threads, as in ``score_views``.

    Raises ``SubmissionError`` if an entry is invalid.
    """
    submission, folder = evaluation.submission, evaluation.folder
    read = _Entries(submission, folder.expected_views())
    truths = ((config.name, config_truth(folder, config, progress)) for config in evaluation.configs)

    def each(name: str, work: Callable[[int], ViewScore], positions: Sequence[int]) -> list[ViewScore]:
        return map_with_progress(work, positions, workers, progress, f"scoring {name}", len(positions))

    def use_valid(prediction_m: Depth, score: ViewScore) -> None:
        if use_view is not None and not read.problems:
            use_view(prediction_m, score)

    with ThreadPoolExecutor(1) as pool:
        sha256 = pool.submit(submission.sha256)
        tables, views = score_views(truths, read.depth, evaluation.declared, each, use_valid)
        read.check([view.view_id for view in views])
        return Result(
            dataset=DatasetIdentity(folder.digest, folder.version),
            submission=SubmissionIdentity(
                evaluation.method,
                sha256.result(),
                evaluation.declared.inputs,
                evaluation.declared.uses_ground_truth,
            ),
            software=SoftwareIdentity(software_version()),
            tables=tables,
            views=views,
        )


@dataclass(frozen=True)
class _Entries:
    """Depth of the entries of a submission; problems of invalid ones are collected, so that all are reported."""

    submission: SubmissionReader
    grids: dict[str, tuple[int, int]]
    problems: dict[str, Problem] = field(default_factory=dict)

    def depth(self, view_id: str) -> Depth:
        """Return the depth of a view, no predictions if its entry is invalid: then nothing is scored at all."""
        try:
            return self.submission.read(view_id)
        except EntryError as error:
            self.problems[view_id] = error.problem
            return np.broadcast_to(np.float32(0), self.grids[view_id])

    def check(self, scored: Sequence[str]) -> None:
        """Raise ``SubmissionError`` with all problems: of the ``scored`` views in order, then of all others."""
        others = sorted(set(self.submission.view_ids) - set(scored))
        for view_id in others:  # Views without scored pixels.
            self.depth(view_id)
        problems = [self.problems[view_id] for view_id in (*scored, *others) if view_id in self.problems]
        if problems:
            raise SubmissionError.from_problems(self.submission.path, problems)
