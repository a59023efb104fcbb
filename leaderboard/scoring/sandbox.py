"""Checking and scoring of one archive, as they run in a process of their own (``isolation.call_isolated``).

Pictures of views are rendered as in the command line's report. A submitter can reconstruct the ground truth from
them, so they are only for leaderboards with public ground truth.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING

from rebar_depth_bench.base.errors import DatasetError, Problem, SubmissionError
from rebar_depth_bench.base.names import TEST_SPLIT, config_of, split_of
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.scoring.table import ViewScore
from rebar_depth_bench.submission import SubmissionMeta, SubmissionReader
from rebar_depth_bench.submission.declaration import RANKS_METRIC

if TYPE_CHECKING:
    from rebar_depth_bench.reporting.html.views import ShownView


@dataclass(frozen=True)
class ViewPicture:
    """Pictures of a view: WebP images by kind, and a JSON object with their size and the texts of colour bars."""

    view_id: str
    facts_json: str
    images: Mapping[str, bytes]


@dataclass(frozen=True)
class Outcome:
    """Outcome of scoring: the result JSON, notes on possible mistakes, pictures; or the reason of the failure."""

    result: bytes | None = None
    notes: Sequence[str] = ()
    pictures: Sequence[ViewPicture] = ()
    reason: str | None = None
    archive_missing: bool = False


def check(archive: Path, data: str) -> SubmissionMeta:
    """Return the content of ``submission.json`` of an archive. Raises ``SubmissionError`` with all problems."""
    with SubmissionReader(archive, open_folder(data).expected_views()) as submission:
        meta = submission.meta
        conflicts = [] if meta is None else meta.kind_problems(RANKS_METRIC)
        conflicts += _split_problems(submission.view_ids)
        if problems := conflicts or list(submission.problems()):
            raise SubmissionError.from_problems("the archive", problems)
        assert meta is not None
        return meta


def _split_problems(view_ids: Iterable[str]) -> Iterator[Problem]:
    """Yield a problem for each config whose views are of another split than the one that is ranked."""
    for config, split in sorted({(config_of(view_id), split_of(view_id) or TEST_SPLIT) for view_id in view_ids}):
        if split != TEST_SPLIT:
            yield Problem("conflict", config, f"the archive covers the split {split}", f"the split {TEST_SPLIT}")


def score(archive: Path, data: str, dataset_digest: str, error_maps: int, hidden_truth: bool) -> Outcome:
    """Return result, notes, and pictures of the ``error_maps`` worst views and the median view of each config.

    Raises ``SubmissionError``, with ``hidden_truth`` also for a view of low coverage, and ``DatasetError``.
    """
    # Half a second to import, which a check does not need.
    from rebar_depth_bench.reporting.html.page import look_at_views, views_by_config
    from rebar_depth_bench.scoring.evaluation import open_evaluation, score_evaluation
    from rebar_depth_bench.scoring.result import check_view_coverage

    digest = open_folder(data).digest
    if digest != dataset_digest:  # Checked first: on another dataset, the archive could seem invalid.
        raise DatasetError(f"{data}: the digest is {digest}, expected {dataset_digest}")
    with open_evaluation(archive, data) as evaluation:
        evaluation.require_metric(RANKS_METRIC)
        result = score_evaluation(evaluation)
        if hidden_truth:
            check_view_coverage(result.views)
        views = views_by_config(result) if error_maps else {}
        chosen = {name: views_to_picture(of_config, error_maps) for name, of_config in views.items()}
        found = look_at_views(evaluation, chosen)
    notes = [mistake.text for mistake in found.mistakes]
    return Outcome(result.to_json(), notes, list(map(_picture, found.shown)))


def views_to_picture(views: Sequence[ViewScore], count: int) -> list[ViewScore]:
    """Return the ``count`` worst of the views by rank error, and the median view, worst first."""
    worst_first = sorted(views, key=attrgetter("rank_error"), reverse=True)
    median = worst_first[len(worst_first) // 2 : len(worst_first) // 2 + 1]
    return [*worst_first[:count], *(view for view in median if view not in worst_first[:count])]


def _picture(shown: ShownView) -> ViewPicture:
    size = {"width": shown.width, "height": shown.height}
    facts = {**size, "near": shown.near, "far": shown.far, "limit": shown.native_limit}
    images = {
        "colour": shown.colour,
        "truth": shown.truth,
        "prediction": shown.prediction,
        "error": shown.native_error,
    }
    stored = {kind: webp for kind, webp in images.items() if webp is not None}
    return ViewPicture(shown.score.view_id, json.dumps(facts), stored)
