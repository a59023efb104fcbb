"""An archive as a study reads it: view by view on the scored pixels, refused exactly as ``score`` refuses it."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from jaxtyping import Float, Float64
from numpy import ndarray

from rebar_depth_bench.errors import InputError, SubmissionError
from rebar_depth_bench.folder import DatasetFolder
from rebar_depth_bench.ground_truth import ViewTruth
from rebar_depth_bench.metrics import is_prediction
from rebar_depth_bench.progress import Progress, silent
from rebar_depth_bench.protocol import PROTOCOL
from rebar_depth_bench.stamp import ArchiveStamp, Stamp
from rebar_depth_bench.streaming import ordered_map
from rebar_depth_bench.submission import SubmissionReader, config_of, open_submission

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class ViewPairs:
    """One view's scored pixels that have a prediction: prediction p and truth z, planar depth in metres."""

    view_id: str
    scored_px: int
    p_m: Float64[ndarray, " n"]
    z_m: Float64[ndarray, " n"]


@contextmanager
def opened(
    archive: str | os.PathLike[str], folder: DatasetFolder, progress: Progress = silent
) -> Iterator[SubmissionReader]:
    """Yield an archive all of whose entries can be read; raise ``SubmissionError`` with all problems otherwise."""
    with open_submission(archive, folder.expected_views()) as submission:
        problems = list(submission.problems(progress))
        if problems:
            raise SubmissionError(str(archive), problems)
        yield submission


def archive_stamp(submission: SubmissionReader, folder: DatasetFolder) -> Stamp:
    """Return the stamp of a study of one sound archive against a dataset folder."""
    method = submission.meta.method if submission.meta else ""
    archives = (ArchiveStamp(method, submission.sha256()),)
    return Stamp(PROTOCOL, folder.digest, folder.version, archives)


def configs_of(submission: SubmissionReader, folder: DatasetFolder) -> list[str]:
    """Return the configs that an archive holds, in the folder's order."""
    present = {config_of(view_id) for view_id in submission.view_ids}
    return [config for config in folder.configs if config in present]


def one_config(submission: SubmissionReader, folder: DatasetFolder, wanted: str | None) -> str:
    """Return the config to study; without a ``wanted`` one the archive's only one. Raises ``InputError``."""
    present = configs_of(submission, folder)
    if wanted is None and len(present) == 1:
        return present[0]
    if wanted is None:
        raise InputError(f"{submission.path}: holds {', '.join(present)}, expected --config with one of them")
    if wanted not in present:
        raise InputError(f"{submission.path}: has no config {wanted!r}, expected one of {', '.join(present)}")
    return wanted


def map_views(
    submission: SubmissionReader,
    truths: Iterable[ViewTruth],
    total: int,
    make: Callable[[ViewPairs], T],
    what: str,
    progress: Progress = silent,
) -> list[T]:
    """Return ``make`` of the pairs of ``total`` views, in order, computed on all cores, few views in memory."""
    made: list[T] = []
    outcomes = ordered_map(lambda truth: make(pairs(truth, submission.read(truth.view_id))), truths, None)
    for done, one in enumerate(outcomes, start=1):
        progress(what, done, total)
        made.append(one)
    return made


def pairs(truth: ViewTruth, prediction_m: Float[ndarray, "h w"]) -> ViewPairs:
    """Return a view's pairs: as the score takes them, pixels that are not finite and > 0 are left out."""
    gathered = prediction_m.ravel()[truth.index]
    valid = is_prediction(gathered)
    p_m, z_m = gathered[valid].astype(np.float64), truth.depth_m[valid].astype(np.float64)
    return ViewPairs(truth.view_id, len(truth.index), p_m, z_m)
