"""Scoring of a submission archive against a dataset folder by protocol ``rebar-2``."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.errors import Problem, SubmissionError
from rebar_depth_bench.parallel import Progress, map_with_progress, silent
from rebar_depth_bench.scoring.evaluation import Evaluation, open_evaluation
from rebar_depth_bench.scoring.ground_truth import ConfigTruth, ViewTruth, config_truth
from rebar_depth_bench.scoring.groups import GROUPINGS, positions_by_group
from rebar_depth_bench.scoring.metrics import (
    is_valid_prediction,
    median,
    median_scale,
    metrics_at_scales,
    rank_error,
)
from rebar_depth_bench.scoring.protocol import WITHIN_MM
from rebar_depth_bench.scoring.published_match import published_match
from rebar_depth_bench.scoring.reference import constant_errors, mean_reference
from rebar_depth_bench.scoring.result import Result, Table, tabulate
from rebar_depth_bench.scoring.view_score import ViewScore
from rebar_depth_bench.submission import Declaration, EntryError, SubmissionReader
from rebar_depth_bench.version import software_version


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


def score_evaluation(evaluation: Evaluation, *, workers: int | None = None, progress: Progress = silent) -> Result:
    """Score an open submission as ``score`` does. Raises ``SubmissionError`` if an entry is invalid."""
    with ThreadPoolExecutor(1) as pool:
        sha256 = pool.submit(evaluation.submission.sha256)
        tables, views = _score_all(evaluation, workers, progress)
        return Result(
            method=evaluation.method,
            declared=evaluation.declared,
            submission_sha256=sha256.result(),
            dataset_digest=evaluation.folder.digest,
            dataset_version=evaluation.folder.version,
            software_version=software_version(),
            tables=tables,
            views=views,
        )


def score_view(truth: ViewTruth, prediction_m: Float[ndarray, "h w"]) -> ViewScore:
    """Return the metrics of one view's prediction (planar depth, metres) on the view's scored pixels."""
    p_m, z_m, z_median_m = prediction_m.ravel().take(truth.index.astype(np.intp)), truth.depth_m, truth.median_m
    valid = is_valid_prediction(p_m)
    error = rank_error(p_m, z_m, valid)
    constant = truth.constant
    if not valid.all():
        p_m, z_m, constant = p_m[valid], z_m[valid], None
        z_median_m = median(z_m) if len(z_m) else 0.0
    scored_px = len(truth.index)
    coverage = len(p_m) / scored_px
    if not len(p_m):
        return ViewScore(
            truth.view_id, scored_px, coverage, error, None, None, None, dict.fromkeys(WITHIN_MM, 0.0)
        )
    scale = median_scale(p_m, z_median_m)
    (native, scaled), within = metrics_at_scales(p_m, z_m, (1.0, scale), WITHIN_MM)
    return ViewScore(
        view_id=truth.view_id,
        scored_px=scored_px,
        coverage=coverage,
        rank_error=error,
        scale=scale,
        native=native,
        scaled=scaled,
        within_mm={tolerance_mm: count / scored_px for tolerance_mm, count in within.items()},
        scaled_constant=constant or constant_errors(z_m, z_median_m),
    )


def _score_all(
    evaluation: Evaluation, workers: int | None, progress: Progress
) -> tuple[dict[str, Table], list[ViewScore]]:
    """Return the tables by config and the scores of all views. Raises ``SubmissionError`` with all problems."""
    submission = evaluation.submission
    unread = set(submission.view_ids)
    problems: list[Problem] = []
    tables: dict[str, Table] = {}
    views: list[ViewScore] = []
    for config in evaluation.configs:
        truths = config_truth(evaluation.folder, config, progress)
        work = partial(_score_or_problem, submission, truths)
        scored = map_with_progress(
            work, range(len(truths)), workers, progress, f"scoring {config.name}", len(truths)
        )
        scores = [outcome for outcome in scored if isinstance(outcome, ViewScore)]
        views += scores
        problems += [outcome for outcome in scored if isinstance(outcome, Problem)]
        unread.difference_update(truths.view_ids)
        if not problems:
            tables[config.name] = _tabulate_config(config, truths, scores, evaluation.declared)
    problems += _unscored_view_problems(submission, unread)
    if problems:
        raise SubmissionError.from_problems(submission.path, problems)
    return tables, views


def _tabulate_config(
    config: DatasetConfig, truths: ConfigTruth, scores: Sequence[ViewScore], declared: Declaration
) -> Table:
    """Return the table of a config, with the tables of groups of its views if it has splits."""
    references = truths.references
    table = tabulate(
        scores,
        declared,
        mean_reference(references),
        published_match(config),
        config.scenes[0].split if config.has_splits else None,
        config.truth_sigma_m,
    )
    if not config.has_splits:
        return table

    def of_group(positions: Sequence[int]) -> Table:
        reference = mean_reference(references[position] for position in positions)
        group = [scores[position] for position in positions]
        return tabulate(group, declared, reference, None, table.split, table.truth_sigma_m)

    groups = {
        key: {
            group: of_group(positions) for group, positions in positions_by_group(grouping, truths.traits).items()
        }
        for key, grouping in GROUPINGS.items()
    }
    return replace(table, groups=groups)


def _score_or_problem(submission: SubmissionReader, truths: ConfigTruth, index: int) -> ViewScore | Problem:
    """Return a view's score, or the problem of its entry."""
    truth = truths.view(index)
    try:
        return score_view(truth, submission.read(truth.view_id))
    except EntryError as error:
        return error.problem


def _unscored_view_problems(submission: SubmissionReader, view_ids: Iterable[str]) -> list[Problem]:
    """Return the problems of the entries of views without scored pixels, which are decoded but not scored."""
    problems = []
    for view_id in sorted(view_ids):
        try:
            submission.read(view_id)
        except EntryError as error:
            problems.append(error.problem)
    return problems
