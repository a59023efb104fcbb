"""Task of the scoring process, and the names of the files it writes."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass

RESULT_FILE, PROBLEM_FILE, UNAVAILABLE_FILE, ERROR_MAPS_DIR = "result.json", "problem.txt", "away.txt", "pictures"
NO_MEMORY = "scoring needed more memory than this service allows"


@dataclass(frozen=True)
class ScoringTask:
    """Input of the scoring process.

    ``archives`` is the URL of the archive storage, ``data`` the dataset, ``out`` the output folder, ``memory`` the
    limit in bytes, ``error_maps`` the number of views per config, ``hidden_truth`` whether archives with a view of
    low coverage fail, ``parent`` the id of the waiting process.
    """

    archives: str
    submission_id: str
    data: str
    dataset_digest: str
    out: str
    memory: int
    error_maps: int
    hidden_truth: bool
    parent: int

    def to_json(self) -> bytes:
        """Return the task as JSON for the standard input of the process."""
        return json.dumps(asdict(self)).encode()
