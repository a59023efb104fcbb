"""One archive, scored or checked in a process of its own, so that a poisoned one takes nothing else down.

``python -m leaderboard.scoring_process`` reads a task as JSON from standard input and writes what it came to into
the folder the task names: ``result.json``, ``problem.txt``, error maps.
"""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

from leaderboard.limits import confine
from rebar_depth_bench.errors import RebarDepthError, SubmissionError, problem_summary

RESULT, PROBLEM, PICTURES = "result.json", "problem.txt", "pictures"
NO_MEMORY = "needs more memory than this service allows"


@dataclass(frozen=True)
class Task:
    """An archive to score against a dataset into a folder; memory in bytes; views of a config to draw maps of.

    ``parent`` is the process that waits for it.
    """

    archive: str
    data: str
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
    try:
        _score(task)
    except SubmissionError as error:  # without the archive's path, which is this machine's affair
        (Path(task.out) / PROBLEM).write_text(problem_summary(error.problems))
    except RebarDepthError as error:
        (Path(task.out) / PROBLEM).write_text(str(error))
    except MemoryError:
        (Path(task.out) / PROBLEM).write_text(NO_MEMORY)
    return 0


def _score(task: Task) -> None:
    from rebar_depth_bench import score

    result = score(task.archive, task.data)
    if task.error_maps:
        from leaderboard.error_maps import draw

        (Path(task.out) / PICTURES).mkdir()
        for number, (view_id, webp) in enumerate(draw(task.archive, task.data, result, task.error_maps)):
            (Path(task.out) / PICTURES / f"{number:04d}.webp").write_bytes(webp)
            (Path(task.out) / PICTURES / f"{number:04d}.txt").write_text(view_id)
    (Path(task.out) / RESULT).write_bytes(result.to_json())


if __name__ == "__main__":
    sys.exit(main())
