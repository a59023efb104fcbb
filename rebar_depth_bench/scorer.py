"""Scoring of an archive: ``score`` opens it, compares each view with the truth, and tabulates the numbers."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING

from jaxtyping import Float
from numpy import ndarray

from rebar_depth_bench import software_version
from rebar_depth_bench.base.errors import InputError, RebarDepthError, SubmissionError
from rebar_depth_bench.base.parallel import Progress, map_in_threads, silent
from rebar_depth_bench.base.writing import output_file
from rebar_depth_bench.data.manifest import DatasetConfig, DatasetFolder
from rebar_depth_bench.diagnosis.corrections import KeptPredictions
from rebar_depth_bench.diagnosis.diagnose import PossibleMistake, diagnose
from rebar_depth_bench.scoring.evaluation import Evaluation, open_evaluation
from rebar_depth_bench.scoring.protocol import PROTOCOL, RELATIVE_PROTOCOL
from rebar_depth_bench.scoring.result import DatasetIdentity, Result, SoftwareIdentity, SubmissionIdentity
from rebar_depth_bench.scoring.table import Frame, Table, Truth, tabulate
from rebar_depth_bench.scoring.truth import config_truth, scored_counts
from rebar_depth_bench.scoring.view_numbers import view_numbers
from rebar_depth_bench.submission import EntryError
from rebar_depth_bench.submission.declaration import METRIC, Declaration

if TYPE_CHECKING:
    from rebar_depth_bench.extended.estimates import ViewSamples
    from rebar_depth_bench.extended.families import ExtendedViews
    from rebar_depth_bench.extended.frames import SteelFrames
    from rebar_depth_bench.extended.ground_truth import ConfigSteelTruth

VIEWS_SHOWN = 12
"""Default number of views of a config shown with images, about 150 kB each at 1280 x 720."""


def score(
    archive: str | os.PathLike[str],
    root: str | Path | DatasetFolder,
    *,
    workers: int | None = None,
    expect_digest: str | None = None,
    align: str | None = None,
    extended: bool = False,
    progress: Progress = silent,
) -> ScoredResult:
    """Score an archive against a dataset folder or Hub repository.

    An archive is scored by the kind of its predictions; with ``align``, a metric one is scored as another kind.
    ``extended`` adds the extended measures, which need metric predictions; they are null for a config without
    masks or bar ids. A folder that is open already may be restricted to some configs and views.

    Views are read directly from the archive and scored on ``workers`` threads (default: one per core); only a few
    views are in memory at a time. The result does not depend on the number of workers.

    Raises ``SubmissionError`` with all problems if any part of the archive is invalid, and ``DatasetError`` if the
    dataset folder is invalid or its digest is not ``expect_digest``.
    """
    archive_stat = file_stat(archive)
    with open_evaluation(archive, root, expect_digest=expect_digest) as evaluation, ThreadPoolExecutor(1) as pool:
        folder, submission, meta = evaluation.folder, evaluation.submission, evaluation.meta
        kind = evaluation.scored_kind(align)
        if extended:
            evaluation.require_metric("extended measures are in metres")
            if align is not None:
                raise InputError(f"extended is true and align is {align}, expected None for measures in metres")
        sha256 = pool.submit(submission.sha256)

        def read_and_score(truth: ScoringTruth, position: int) -> ViewResult:
            prediction = submission.read(truth.scored.view_ids[position])
            return score_view(prediction, truth, position, kind, meta.prediction)

        scored: dict[str, ScoredConfig] = {}
        try:
            for config in evaluation.configs:
                truth = ScoringTruth.of(folder, config, extended=extended, progress=progress)
                count, task = len(truth.scored.view_ids), f"scoring {config.name}"
                work = partial(read_and_score, truth)
                views = map_in_threads(work, range(count), count, task, workers=workers, progress=progress)
                scored[config.name] = tabulate_config(list(views), truth, kind, meta.declaration)
            # Views without scored pixels have no numbers, but their entries must be valid, too.
            without_pixels = set(submission.view_ids)
            for config_scores in scored.values():
                without_pixels -= set(config_scores.frame.view_ids)
            for view_id in without_pixels:
                submission.read(view_id)
        except EntryError:
            raise SubmissionError.from_problems(archive, list(submission.problems(progress))) from None
        return scored_result(
            scored,
            folder,
            SubmissionIdentity(meta.method, sha256.result(), meta.inputs, meta.uses_ground_truth),
            kind,
            meta.prediction,
            archive=submission.path.absolute(),
            archive_stat=archive_stat,
            archive_notes=submission.notes,
        )


@dataclass(frozen=True, eq=False)
class ScoringTruth:
    """Ground truth of a config: of its scored pixels, and of its steel if extended measures are computed."""

    config: DatasetConfig
    scored: Truth
    steel: ConfigSteelTruth | None
    extended: bool

    @classmethod
    def of(
        cls, folder: DatasetFolder, config: DatasetConfig, *, extended: bool, progress: Progress = silent
    ) -> ScoringTruth:
        """Return the ground truth of a config, from the user's cache or computed from its rows."""
        steel = None
        if extended:
            # A third of the package, which other scores do not need.
            from rebar_depth_bench.extended.ground_truth import has_bar_ids, load_steel_truth

            steel = load_steel_truth(folder, config, progress) if has_bar_ids(config) else None
        return cls(config, config_truth(folder, config, progress), steel, extended)


@dataclass(frozen=True)
class ViewResult:
    """Numbers of a view by place; if extended measures are computed, its samples, and those of its steel."""

    numbers: Mapping[str, float]
    samples: ViewSamples | None = None
    frames: SteelFrames | None = None


@dataclass(frozen=True)
class ScoredConfig:
    """Numbers of the views of a config, their table, and their samples if extended measures are computed."""

    frame: Frame
    table: Table
    extended: ExtendedViews | None


def score_view(
    prediction: Float[ndarray, "h w"], truth: ScoringTruth, position: int, kind: str, declared_kind: str
) -> ViewResult:
    """Return numbers and samples of the view at a position among the scored views of the config.

    ``prediction``, of the kind ``declared_kind``, is scored as ``kind``; metric ones are planar depth in metres.
    """
    numbers = view_numbers(prediction, truth.scored.views[position], kind, declared_kind)
    if truth.steel is None:
        return ViewResult(numbers)
    from rebar_depth_bench.extended.families import view_samples
    from rebar_depth_bench.extended.frames import steel_frames

    steel = truth.steel.view(position)
    frames = steel_frames(prediction, steel, position)
    return ViewResult(numbers, view_samples(prediction, steel, numbers.get("scale", math.nan), frames), frames)


def tabulate_config(
    views: Sequence[ViewResult], truth: ScoringTruth, kind: str, declaration: Declaration
) -> ScoredConfig:
    """Return the table and frame of a config from the results of all of its scored views, in order."""
    scored = truth.scored
    rows = {
        view_id: {**view.numbers, **references}
        for view_id, view, references in zip(scored.view_ids, views, scored.references, strict=True)
    }
    frame = Frame.of_rows(rows)
    table = tabulate(frame, scored, kind, declaration)
    if truth.config.whole is not truth.config:
        table = table.of_some_views(len(scored_counts(truth.config.whole)))
    if not truth.extended:
        return ScoredConfig(frame, table, None)
    from rebar_depth_bench.extended.families import ExtendedViews

    found = zip(scored.view_ids, views, strict=True)
    extended = ExtendedViews(
        truth.config,
        None if truth.steel is None else truth.steel.source,
        {view_id: view.samples for view_id, view in found if view.samples is not None},
        [view.frames for view in views if view.frames is not None],
    )
    return ScoredConfig(frame, table, extended)


def scored_result(
    scored: Mapping[str, ScoredConfig],
    folder: DatasetFolder,
    submission: SubmissionIdentity,
    kind: str,
    declared_kind: str,
    *,
    archive: Path | None = None,
    archive_stat: tuple[int, ...] = (),
    archive_notes: Sequence[str] = (),
    kept: Mapping[str, KeptPredictions] | None = None,
) -> ScoredResult:
    """Return the result of scored configs; ``ScoredResult`` documents the other arguments."""
    extended, samples = None, [one.extended for one in scored.values() if one.extended is not None]
    if samples:
        from rebar_depth_bench.extended.families import extended_result

        extended = extended_result(samples)
    return ScoredResult(
        dataset=DatasetIdentity(folder.digest, folder.version),
        submission=submission,
        software=SoftwareIdentity(software_version()),
        tables={name: one.table for name, one in scored.items()},
        frames={name: one.frame for name, one in scored.items()},
        protocol=PROTOCOL if kind == METRIC else RELATIVE_PROTOCOL,
        prediction=None if kind == METRIC else kind,
        declared_prediction=None if kind == declared_kind else declared_kind,
        extended=extended,
        archive=archive,
        archive_stat=archive_stat,
        archive_notes=tuple(archive_notes),
        folder=folder,
        kept=kept or {},
    )


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class ScoredResult(Result):
    """Result whose predictions can be looked at, for possible mistakes and for pictures.

    ``archive`` is the archive that was scored, which is read again, ``archive_stat`` its ``file_stat`` before, and
    ``archive_notes`` say which of its entries are ignored. It is None if the predictions were scored as they
    arrived; then ``kept`` has those that are looked at for mistakes, by config, and there are no pictures.
    """

    folder: DatasetFolder
    archive: Path | None = None
    archive_stat: tuple[int, ...] = ()
    archive_notes: tuple[str, ...] = ()
    kept: Mapping[str, KeptPredictions] = field(default_factory=dict)

    @cached_property
    def mistakes(self) -> Sequence[PossibleMistake]:
        """Possible mistakes in the predictions; they are looked for on the first access.

        Raises ``InputError`` if the archive has gone or changed, and ``DatasetError`` for a damaged dataset.
        """
        if self.archive is None:
            return diagnose(self.kept.values(), self.kind)
        with self._open() as evaluation:
            kept = [KeptPredictions.of_archive(config, evaluation.submission) for config in evaluation.configs]
            return diagnose(kept, evaluation.meta.prediction, evaluation.meta.depth_scale)

    @cached_property
    def notes(self) -> tuple[str, ...]:
        """Sentences on what limits the numbers, and on possible mistakes in the predictions.

        If the archive has gone or changed, a sentence says that no mistakes were looked for.
        """
        try:
            mistakes = [f"possible mistake: {mistake.text}" for mistake in self.mistakes]
        except RebarDepthError as error:
            mistakes = [f"possible mistakes were not looked for: {' '.join(str(error).split())}"]
        return (*super().notes, *mistakes)

    def to_html(self, path: str | Path, *, views_shown: int = VIEWS_SHOWN) -> None:
        """Write the self-contained report of ``rebar-bench score --html``.

        Up to ``views_shown`` views of each config are shown with images, if there is an archive. Raises
        ``InputError`` if the archive has gone or changed.
        """
        from rebar_depth_bench.reporting.html.page import write_report

        mistakes = self.mistakes
        with nullcontext() if self.archive is None else self._open() as evaluation:
            write_report(self, mistakes, evaluation, Path(path), views_shown=views_shown)

    def save_archive(self, path: str | Path) -> None:
        """Copy the archive of the predictions.

        Raises ``InputError`` if there is none, if only some views were evaluated, and if the archive has gone or
        changed.
        """
        if self.archive is None:
            found = "the predictions were scored as they arrived and not kept"
            raise InputError(f"{found}, expected archive=PATH in evaluate() or Evaluator(), which writes them")
        for name, table in self.tables.items():
            if table.of_views is not None:
                found = f"{name}: {table.views} of {table.of_views} views were evaluated"
                raise InputError(f"{found}, expected all views of a config in an archive")
        with self._open() as evaluation, output_file(Path(path)) as target:
            shutil.copyfile(evaluation.submission.path, target)

    @contextmanager
    def _open(self) -> Iterator[Evaluation]:
        """Open the archive again. Raises ``InputError`` unless it is the one that was scored."""
        assert self.archive is not None
        with open_evaluation(self.archive, self.folder) as evaluation:
            # The digest of a large archive takes seconds, and a file that was not written to has the same.
            is_same = file_stat(self.archive) == self.archive_stat != ()
            expected = self.submission.sha256
            found = expected if is_same else evaluation.submission.sha256()
            if found != expected:
                of_scored = f"expected {str(expected)[:12]}... of the archive that was scored"
                raise InputError(
                    f"{self.archive}: has the SHA-256 {str(found)[:12]}..., {of_scored}; score it again"
                )
            yield evaluation


def file_stat(path: str | os.PathLike[str]) -> tuple[int, ...]:
    """Return device, inode, size and time of the last change of a file, which differ once it was written to.

    The result is empty if there is no such file.
    """
    try:
        found = Path(path).stat()
    except OSError:
        return ()
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns
