"""One archive, scored or checked in a process of its own, so that a poisoned one takes nothing else down.

``python -m leaderboard.scoring_process`` reads a task as JSON from standard input and writes what it came to into
the folder the task names: ``result.json`` and error maps; or ``problem.txt``, why the archive fails; or
``away.txt``, what this machine lacks.
"""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

from leaderboard.archives import Archives, GoneError
from leaderboard.limits import confine
from rebar_depth_bench.errors import DatasetError, RebarDepthError, SubmissionError, problem_summary
from rebar_depth_bench.folder import open_folder

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
        from leaderboard.error_maps import draw

        (Path(task.out) / PICTURES).mkdir()
        for number, (view_id, webp) in enumerate(draw(archive, task.data, result, task.error_maps)):
            (Path(task.out) / PICTURES / f"{number:04d}.webp").write_bytes(webp)
            (Path(task.out) / PICTURES / f"{number:04d}.txt").write_text(view_id)
    (Path(task.out) / RESULT).write_bytes(result.to_json())


if __name__ == "__main__":
    sys.exit(main())
