"""Task of the sandbox process, and the names of the files it writes."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Literal

META_FILE, PROBLEMS_FILE = "meta.json", "problems.json"
"""Outcome of a check: the content of ``submission.json``, or the problems of the archive."""
RESULT_FILE, NOTES_FILE, PICTURES_DIR = "result.json", "notes.json", "pictures"
"""Outcome of scoring: the result, notes on possible mistakes, and pictures of views."""
UNAVAILABLE_FILE = "unavailable.txt"
"""Infrastructure error: the dataset or the disk, not the archive."""


@dataclass(frozen=True)
class SandboxTask:
    """Input of the sandbox process.

    ``archive`` and ``data`` are the paths of archive and dataset, ``out`` is the output folder, ``memory`` the
    limit in bytes, ``parent`` the id of the waiting process. For scoring, ``dataset_digest`` is the expected
    digest, ``error_maps`` the number of worst views per config to picture, and ``hidden_truth`` tells whether
    archives with a view of low coverage fail.
    """

    action: Literal["check", "score"]
    archive: str
    data: str
    out: str
    memory: int
    parent: int
    dataset_digest: str = ""
    error_maps: int = 0
    hidden_truth: bool = False

    def to_json(self) -> bytes:
        """Return the task as JSON for the standard input of the process."""
        return json.dumps(asdict(self)).encode()
