"""Sandboxed scoring process for one archive, so that a malicious archive cannot affect the rest of the service.

``python -m leaderboard.scoring.sandbox`` reads a ``ScoringTask`` as JSON from standard input and writes one of
these to the task's output folder: ``result.json`` and error maps; ``problem.txt`` with the reason why the archive
fails; or ``away.txt`` with the infrastructure error (dataset, storage, disk).

Error maps of the worst views are rendered as in the command line's report. A submitter can reconstruct the ground
truth from their prediction and its error map, so error maps are only for leaderboards with public ground truth.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

from leaderboard.scoring.process_limits import limit_process
from leaderboard.scoring.task import (
    ERROR_MAPS_DIR,
    NO_MEMORY,
    PROBLEM_FILE,
    RESULT_FILE,
    UNAVAILABLE_FILE,
    ScoringTask,
)
from leaderboard.storage.archive_store import ArchiveNotFoundError, ArchiveStore
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.errors import DatasetError, RebarDepthError, SubmissionError, problem_summary
from rebar_depth_bench.reporting.html.page import iter_view_panels
from rebar_depth_bench.reporting.html.view_images import error_webp
from rebar_depth_bench.scoring.disclosure import check_view_coverage
from rebar_depth_bench.scoring.evaluation import Evaluation, open_evaluation
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.scoring.score import score_evaluation
from rebar_depth_bench.scoring.view_score import sort_key_worst_first
from rebar_depth_bench.view_ids import config_of


def render_error_maps(evaluation: Evaluation, result: Result, count: int) -> Iterator[tuple[str, bytes]]:
    """Yield (view id, WebP bytes) of the native error maps of the ``count`` worst views of each config."""
    worst = {
        config: sorted(
            (view for view in result.views if config_of(view.view_id) == config),
            key=sort_key_worst_first,
            reverse=True,
        )[:count]
        for config in result.tables
    }
    for panels in iter_view_panels(worst, evaluation):
        yield panels.view_id, error_webp(panels)


def main() -> int:
    """Score the task on standard input; return exit status 0, also if a problem was reported in a file."""
    task = ScoringTask(**json.load(sys.stdin))
    limit_process(task.memory, task.parent)
    out = Path(task.out)
    try:
        with ArchiveStore(task.archives).local_copy(task.submission_id, out) as archive:
            _score(str(archive), task)
    except ArchiveNotFoundError:
        (out / PROBLEM_FILE).write_text("the archive is no longer in the archive storage")
    except SubmissionError as error:  # Without the path of the archive on this machine.
        (out / PROBLEM_FILE).write_text(problem_summary(error.problems))
    except MemoryError:
        (out / PROBLEM_FILE).write_text(NO_MEMORY)
    except (RebarDepthError, OSError) as error:  # Dataset, cache or disk, not the archive.
        (out / UNAVAILABLE_FILE).write_text(str(error))
    return 0


def _score(archive: str, task: ScoringTask) -> None:
    digest = open_folder(task.data).digest
    if digest != task.dataset_digest:  # Checked first: on another dataset, the archive could seem invalid.
        raise DatasetError(f"{task.data}: the digest is {digest}, expected {task.dataset_digest}")
    with open_evaluation(archive, task.data) as evaluation:
        result = score_evaluation(evaluation)
        if task.hidden_truth:
            check_view_coverage(result.views)
        if task.error_maps:
            folder = Path(task.out) / ERROR_MAPS_DIR
            folder.mkdir()
            for number, (view_id, webp) in enumerate(render_error_maps(evaluation, result, task.error_maps)):
                (folder / f"{number:04d}.webp").write_bytes(webp)
                (folder / f"{number:04d}.txt").write_text(view_id)
    (Path(task.out) / RESULT_FILE).write_bytes(result.to_json())


if __name__ == "__main__":
    sys.exit(main())
