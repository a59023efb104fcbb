"""Sandboxed process that checks or scores one archive, so that a malicious archive cannot affect the service.

``python -m leaderboard.scoring.sandbox`` reads a ``SandboxTask`` as JSON from standard input and writes its
outcome to the task's output folder, in the files that ``task`` names.

Pictures of views are rendered as in the command line's report. A submitter can reconstruct the ground truth from
them, so they are only for leaderboards with public ground truth.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

from leaderboard.scoring.process_limits import limit_process
from leaderboard.scoring.task import (
    META_FILE,
    NOTES_FILE,
    PICTURES_DIR,
    PROBLEMS_FILE,
    RESULT_FILE,
    UNAVAILABLE_FILE,
    SandboxTask,
)
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.errors import DatasetError, Problem, RebarDepthError, SubmissionError
from rebar_depth_bench.submission import open_submission
from rebar_depth_bench.view_ids import TEST_SPLIT, config_of, split_of

NO_MEMORY = Problem("size", "", "the archive needs more memory than this service allows")


def main() -> int:
    """Run the task on standard input; return exit status 0, also if the archive has problems."""
    task = SandboxTask(**json.load(sys.stdin))
    limit_process(task.memory, task.parent)
    out = Path(task.out)
    try:
        problems = _check(task, out) if task.action == "check" else _score(task, out)
    except SubmissionError as error:
        problems = error.problems
    except MemoryError:
        problems = [NO_MEMORY]
    except (RebarDepthError, OSError) as error:  # Dataset, cache or disk, not the archive.
        (out / UNAVAILABLE_FILE).write_text(str(error))
        return 0
    if problems:
        (out / PROBLEMS_FILE).write_text(json.dumps([asdict(problem) for problem in problems]))
    return 0


def _check(task: SandboxTask, out: Path) -> Sequence[Problem]:
    """Return the problems of the archive; write its metadata if it has none."""
    with open_submission(task.archive, open_folder(task.data).expected_views()) as submission:
        problems = list(_split_problems(submission.view_ids)) or list(submission.problems())
        if submission.meta is not None and not problems:
            (out / META_FILE).write_text(submission.meta.model_dump_json())
        return problems


def _split_problems(view_ids: Iterable[str]) -> Iterator[Problem]:
    """Yield a problem for each config whose views are of another split than the one that is ranked."""
    for config, split in sorted({(config_of(view_id), split_of(view_id) or TEST_SPLIT) for view_id in view_ids}):
        if split != TEST_SPLIT:
            yield Problem("conflict", config, f"the archive covers the split {split}", f"the split {TEST_SPLIT}")


def _score(task: SandboxTask, out: Path) -> Sequence[Problem]:
    """Write the result, notes and pictures. Raises ``SubmissionError`` with the problems of the archive."""
    # Half a second to import, which a check does not need.
    from leaderboard.scoring.pictures import write_pictures
    from rebar_depth_bench.diagnosis.diagnose import diagnose
    from rebar_depth_bench.scoring.disclosure import check_view_coverage
    from rebar_depth_bench.scoring.evaluation import open_evaluation
    from rebar_depth_bench.scoring.score import score_evaluation

    digest = open_folder(task.data).digest
    if digest != task.dataset_digest:  # Checked first: on another dataset, the archive could seem invalid.
        raise DatasetError(f"{task.data}: the digest is {digest}, expected {task.dataset_digest}")
    with open_evaluation(task.archive, task.data) as evaluation:
        result = score_evaluation(evaluation)
        if task.hidden_truth:
            check_view_coverage(result.views)
        (out / NOTES_FILE).write_text(json.dumps([mistake.text for mistake in diagnose(evaluation)]))
        if task.error_maps:
            write_pictures(evaluation, result, task.error_maps, out / PICTURES_DIR)
    (out / RESULT_FILE).write_bytes(result.to_json())
    return []


if __name__ == "__main__":
    sys.exit(main())
