"""One archive, scored or checked in a process of its own, so that a poisoned one takes nothing else down.

``python -m leaderboard.scoring.sandbox`` reads a task as JSON from standard input and writes what it came to into
the folder the task names: ``result.json`` and error maps; or ``problem.txt``, why the archive fails; or
``away.txt``, what this machine lacks.

Error maps of the worst views, as the command line's report draws them.

Whoever knows a prediction and its error knows the truth: error maps are for boards whose truth is no secret.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from leaderboard.scoring.process_limits import confine
from leaderboard.storage.archive_store import Archives, GoneError
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.errors import DatasetError, RebarDepthError, SubmissionError, problem_summary
from rebar_depth_bench.reporting.html.page import panels_of
from rebar_depth_bench.reporting.html.view_images import error_webp
from rebar_depth_bench.scoring.result import Result, badness
from rebar_depth_bench.submission import config_of, open_submission


def draw(archive: str, data: str, result: Result, count: int) -> Iterator[tuple[str, bytes]]:
    """Yield the native error maps, WebP, of the ``count`` worst views of each config by view id."""
    worst = {
        config: sorted(
            (view for view in result.views if config_of(view.view_id) == config), key=badness, reverse=True
        )[:count]
        for config in result.tables
    }
    with open_submission(archive, open_folder(data).expected_views()) as submission:
        for panels in panels_of(worst, data, submission):
            yield panels.view_id, error_webp(panels)


RESULT, PROBLEM, AWAY, PICTURES = "result.json", "problem.txt", "away.txt", "pictures"
NO_MEMORY = "needs more memory than this service allows"


@dataclass(frozen=True)
class Task:
    """An archive to score against a dataset into a folder; memory in bytes; views of a config to draw maps of.

    ``archives`` is the URL of their place, ``parent`` the process that waits.
    """

    archives: str
    submission_id: str
    data: str
    dataset_digest: str
    out: str
    memory: int
    error_maps: int
    parent: int

    def to_json(self) -> bytes:
        """Return the task for the process's standard input."""
        return json.dumps(asdict(self)).encode()


def main() -> int:
    """Score the task on standard input; return 0 if it came to an end, be it a problem in words."""
    task = Task(**json.load(sys.stdin))
    confine(task.memory, task.parent)
    out = Path(task.out)
    try:
        with Archives(task.archives).local(task.submission_id, out) as archive:
            _score(str(archive), task)
    except GoneError:
        (out / PROBLEM).write_text("the archive is no longer there")
    except SubmissionError as error:  # without the archive's path, which is this machine's affair
        (out / PROBLEM).write_text(problem_summary(error.problems))
    except MemoryError:
        (out / PROBLEM).write_text(NO_MEMORY)
    except (RebarDepthError, OSError) as error:  # the dataset, the cache, the disk: no fault of the archive's
        (out / AWAY).write_text(str(error))
    return 0


def _score(archive: str, task: Task) -> None:
    from rebar_depth_bench import score

    digest = open_folder(task.data).digest
    if digest != task.dataset_digest:
        raise DatasetError(f"{task.data}: the digest is {digest}, expected {task.dataset_digest}")
    result = score(archive, task.data)
    if task.error_maps:
        (Path(task.out) / PICTURES).mkdir()
        for number, (view_id, webp) in enumerate(draw(archive, task.data, result, task.error_maps)):
            (Path(task.out) / PICTURES / f"{number:04d}.webp").write_bytes(webp)
            (Path(task.out) / PICTURES / f"{number:04d}.txt").write_text(view_id)
    (Path(task.out) / RESULT).write_bytes(result.to_json())


if __name__ == "__main__":
    sys.exit(main())
