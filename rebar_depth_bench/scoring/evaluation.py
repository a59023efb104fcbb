"""Scoring of a submission archive against a dataset folder: both are open in an ``Evaluation``.

``score_evaluation`` passes their views to the arithmetic of ``scoring.score``, on several threads.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from jaxtyping import Float
from numpy import ndarray

from rebar_depth_bench import software_version
from rebar_depth_bench.base.errors import InputError, SubmissionError, escape_text
from rebar_depth_bench.base.names import TEST_SPLIT, config_of, split_of
from rebar_depth_bench.base.parallel import Progress, map_with_progress, silent
from rebar_depth_bench.data.manifest import DatasetConfig, DatasetFolder, open_folder
from rebar_depth_bench.data.rows import camera_from_row, decode_row
from rebar_depth_bench.data.schema import CAMERA_SHAPES
from rebar_depth_bench.data.shards import encoded_rows
from rebar_depth_bench.geometry.cameras import Camera
from rebar_depth_bench.scoring.protocol import PROTOCOL, RELATIVE_PROTOCOL
from rebar_depth_bench.scoring.relative import ALIGNMENT_BY_KIND, metric_as
from rebar_depth_bench.scoring.result import DatasetIdentity, Result, SoftwareIdentity, SubmissionIdentity
from rebar_depth_bench.scoring.score import ReadDepth, UseView, score_views
from rebar_depth_bench.scoring.truth import config_truth
from rebar_depth_bench.submission import EntryError, SubmissionMeta, SubmissionReader
from rebar_depth_bench.submission.declaration import METRIC

_Found = TypeVar("_Found")


@dataclass(frozen=True)
class Provenance:
    """Provenance of the numbers of a comparison, or of an analysis of archives.

    ``protocol`` names the definitions of the numbers; changed definitions have a new name. ``dataset`` is None if
    the reference is not a dataset folder.
    """

    protocol: str
    dataset: DatasetIdentity | None
    archives: Sequence[SubmissionIdentity]

    def to_dict(self) -> dict[str, Any]:
        """Return the provenance entries of a JSON object."""
        return {
            "protocol": self.protocol,
            "dataset": None if self.dataset is None else asdict(self.dataset),
            "submissions": [{"method": archive.method, "sha256": archive.sha256} for archive in self.archives],
            "software": {"version": software_version()},
        }


@dataclass(frozen=True, eq=False)
class View:
    """View of a submission, for diagnosis and pictures: cells and prediction are decoded once, on first use.

    ``position`` counts the views of the config, ``encoded`` is the row, and ``read_depth`` reads predictions.
    """

    config: DatasetConfig
    view_id: str
    position: int
    encoded: Mapping[str, Any]
    read_depth: ReadDepth
    _decoded: dict[str, Any] = field(default_factory=dict)

    @cached_property
    def prediction_m(self) -> Float[ndarray, "h w"]:
        """Submitted planar depth in metres, H x W. Raises ``EntryError`` for an invalid entry."""
        return self.read_depth(self.view_id)

    def cell(self, column: str) -> Any:
        """Return the decoded cell of a column. Raises ``DatasetError`` if it is damaged."""
        if column not in self._decoded:
            row = {"view_id": self.view_id, column: self.encoded[column]}
            self._decoded[column] = decode_row(self.config, row)[column]
        return self._decoded[column]

    def camera(self, eye: str) -> Camera:
        """Return the camera of one eye."""
        cells = {f"{eye}_{kind}": self.cell(f"{eye}_{kind}") for kind in CAMERA_SHAPES}
        return camera_from_row(cells, eye, self.config.grid)


@dataclass(frozen=True)
class Evaluation:
    """Submission whose structure is valid, and the dataset folder it is evaluated against."""

    folder: DatasetFolder
    submission: SubmissionReader
    _made: dict[object, Any] = field(default_factory=dict, repr=False, compare=False)

    @property
    def meta(self) -> SubmissionMeta:
        """Content of ``submission.json``."""
        assert self.submission.meta is not None
        return self.submission.meta

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
        """Yield the views at ``positions`` of a config, one at a time; only their rows are read.

        Raises ``DatasetError`` for a damaged shard.
        """
        position_by_view = {config.view_ids[position]: position for position in positions}
        for row in encoded_rows(config, ("view_id", *columns), position_by_view):
            view_id = row["view_id"]
            yield View(config, view_id, position_by_view[view_id], row, self.submission.read)

    def check_entries(self, progress: Progress = silent) -> None:
        """Decode every entry. Raises ``SubmissionError`` with all problems."""
        problems = list(self.submission.problems(progress))
        if problems:
            raise SubmissionError.from_problems(self.submission.path, problems)

    def kind(self, align: str | None = None) -> str:
        """Return the kind that the predictions are scored as; errors for ``align`` as in ``score_evaluation``."""
        kind = align or self.meta.prediction
        if align is not None and align not in ALIGNMENT_BY_KIND:
            expected = f"{', '.join(ALIGNMENT_BY_KIND)}, or None, which scores metric predictions as metric"
            raise InputError(f"align is {escape_text(str(align))}, expected one of {expected}")
        if kind != self.meta.prediction:
            self.require_metric(f"only they can be scored as {kind}")
        return kind

    def require_metric(self, use: str) -> None:
        """Raise ``SubmissionError`` unless the predictions are metric, which ``use`` requires."""
        if problems := self.meta.kind_problems(use):
            raise SubmissionError.from_problems(self.submission.path, problems)

    def provenance(self) -> Provenance:
        """Return the provenance of an analysis of the submission."""
        archive = SubmissionIdentity(self.meta.method, self.submission.sha256())
        return Provenance(PROTOCOL, DatasetIdentity(self.folder.digest, self.folder.version), [archive])


@contextmanager
def open_evaluation(
    archive: str | os.PathLike[str], root: str | Path | DatasetFolder, *, expect_digest: str | None = None
) -> Iterator[Evaluation]:
    """Open an archive and a dataset folder or Hub repository, and close the archive when the block ends.

    A folder that is open already may be restricted to some configs and views, which the archive then has.

    Raises ``SubmissionError`` with all problems, also those of single entries, if the structure of the archive is
    invalid, and ``DatasetError`` if the dataset folder is, or if its digest is not ``expect_digest``.
    """
    folder = root if isinstance(root, DatasetFolder) else open_folder(root, expect_digest=expect_digest)
    with SubmissionReader(archive, folder.expected_views()) as submission:
        if submission.structure_problems:
            raise SubmissionError.from_problems(archive, list(submission.problems()))
        yield Evaluation(folder, submission)


def score_evaluation(
    evaluation: Evaluation,
    *,
    workers: int | None = None,
    align: str | None = None,
    progress: Progress = silent,
    use_view: UseView | None = None,
) -> Result:
    """Score an open submission on ``workers`` threads; ``use_view`` is called on them, as in ``score_views``.

    Raises ``SubmissionError`` if an entry is invalid, and for ``align`` with an archive that is neither metric nor
    of that kind, and ``InputError`` if ``align`` is no kind.
    """
    submission, folder, meta = evaluation.submission, evaluation.folder, evaluation.meta
    kind, read = evaluation.kind(align), submission.read
    if kind != meta.prediction:

        def read(view_id: str) -> Float[ndarray, "h w"]:
            return metric_as(submission.read(view_id), kind)

    truths = ((config.name, config_truth(folder, config, progress)) for config in evaluation.configs)
    with ThreadPoolExecutor(1) as pool:
        sha256 = pool.submit(submission.sha256)
        try:
            tables, views = score_views(
                truths,
                read,
                meta.declaration,
                lambda name, work, positions: map_with_progress(
                    work, positions, workers, progress, f"scoring {name}", len(positions)
                ),
                use_view,
                kind,
            )
            for view_id in set(submission.view_ids) - {view.view_id for view in views}:
                submission.read(view_id)  # A view without scored pixels.
        except EntryError:
            evaluation.check_entries(progress)
            raise
        return Result(
            dataset=DatasetIdentity(folder.digest, folder.version),
            submission=SubmissionIdentity(meta.method, sha256.result(), meta.inputs, meta.uses_ground_truth),
            software=SoftwareIdentity(software_version()),
            tables=tables,
            views=views,
            protocol=PROTOCOL if kind == METRIC else RELATIVE_PROTOCOL,
            prediction=None if kind == METRIC else kind,
            declared_prediction=None if kind == meta.prediction else meta.prediction,
        )
