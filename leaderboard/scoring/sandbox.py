"""Checking and scoring of one archive, as they run in a process of their own (``isolation.isolated_call``)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rebar_depth_bench.base.errors import DatasetError, Problem, SubmissionError
from rebar_depth_bench.base.names import TEST_SPLIT, config_of, split_of
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.submission import SubmissionMeta, SubmissionReader
from rebar_depth_bench.submission.declaration import RANKS_METRIC


@dataclass(frozen=True)
class Outcome:
    """Outcome of scoring against a dataset: the result JSON and notes on possible mistakes, or why it failed."""

    dataset_digest: str
    result: bytes | None = None
    notes: Sequence[str] = ()
    reason: str | None = None


def check(archive: Path, data: str, dataset_digest: str) -> SubmissionMeta:
    """Return the content of ``submission.json`` of an archive.

    Raises ``SubmissionError`` with all problems, and ``DatasetError`` if ``data`` has another digest.
    """
    folder = open_folder(data)
    _check_digest(data, folder.digest, dataset_digest)
    with SubmissionReader(archive, folder.expected_views()) as submission:
        meta = submission.meta
        conflicts = [] if meta is None else meta.kind_problems(RANKS_METRIC)
        splits = {(config_of(view_id), split_of(view_id) or TEST_SPLIT) for view_id in submission.view_ids}
        for config, split in sorted(splits):
            if split != TEST_SPLIT:
                found = f"the archive covers the split {split}"
                conflicts.append(Problem("conflict", config, found, f"the split {TEST_SPLIT}"))
        if problems := conflicts or list(submission.problems()):
            raise SubmissionError.from_problems("the archive", problems)
        assert meta is not None
        return meta


def score(archive: Path, data: str, dataset_digest: str) -> Outcome:
    """Return the result, and notes on possible mistakes. Raises ``SubmissionError`` and ``DatasetError``."""
    # Half a second to import, which a check does not need.
    from rebar_depth_bench.scorer import score as score_archive
    from rebar_depth_bench.scoring.evaluation import open_evaluation

    _check_digest(data, open_folder(data).digest, dataset_digest)
    with open_evaluation(archive, data) as evaluation:
        evaluation.require_metric(RANKS_METRIC)
    result = score_archive(archive, data)
    mistakes = result.mistakes
    _check_digest(data, result.dataset.digest, dataset_digest)  # The folder may have been replaced meanwhile.
    return Outcome(dataset_digest, result.to_json(), [mistake.text for mistake in mistakes])


def _check_digest(data: str, found: str, expected: str) -> None:
    """Raise ``DatasetError`` for another dataset, on which an archive could seem invalid."""
    if found != expected:
        raise DatasetError(f"{data}: the digest is {found}, expected {expected}, which serve serves")
