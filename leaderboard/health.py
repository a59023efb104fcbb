"""Checks of a leaderboard: dataset, archive folder, disk, workers, queue; for ``/healthz`` and ``check``."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

from sqlalchemy import func, not_, select

from leaderboard.db import jobs
from leaderboard.db.engine import Database
from leaderboard.db.models import SubmissionModel
from leaderboard.db.submissions import QUEUED, SCORING
from leaderboard.service import Service, manifest_state
from rebar_depth_bench.base.errors import StorageError

MIN_FREE_BYTES = 1 << 30
STALLED_S = 600.0
"""Time without a lease after which a queued submission shows that no worker takes it."""


def service_problems(service: Service) -> list[str]:
    """Return what is wrong with a running service. Raises the errors of an unavailable database."""
    problems = [*_dataset_problems(service), *disk_problem(service.spool)]
    try:
        service.archives.check()
    except (StorageError, OSError) as error:
        problems.append(str(error))
    served = service.database.board().dataset_digest
    if served != service.folder.digest:
        problems.append(f"another server of this database serves the dataset {served}")
    expected, running = service.settings.workers, sum(worker.is_alive() for worker in service.workers)
    if running < expected:
        problems.append(f"{running} of {expected} local workers are running")
    return problems + queue_problems(service.database)


def _dataset_problems(service: Service) -> list[str]:
    """Return the problem if the dataset folder is gone or its manifest was replaced; not for a Hub dataset."""
    found = manifest_state(service.settings.data)
    if found == service.manifest_state:
        return []
    return [
        "the manifest of the dataset " + ("cannot be read" if found is None else "has changed since the start")
    ]


def disk_problem(folder: Path, name: str = "the state folder") -> list[str]:
    """Return the problem if the disk of a folder is nearly full."""
    try:
        free = shutil.disk_usage(folder).free
    except OSError as error:
        return [f"{name} cannot be read: {error.strerror}"]
    return [] if free >= MIN_FREE_BYTES else [f"the disk of {name} has {free >> 20} MiB left"]


def queue_problems(database: Database) -> list[str]:
    """Return the problem if the oldest queued submission waits although none is being scored."""
    oldest = select(func.min(SubmissionModel.queued_at)).where(SubmissionModel.status == QUEUED)
    active = select(func.count()).where(SubmissionModel.status == SCORING, not_(jobs.is_free(time.time())))
    with database.read() as session:
        queued_since, scoring = session.scalar(oldest), session.scalar(active)
    if queued_since is None or scoring or time.time() - queued_since < STALLED_S:
        return []
    return [f"no worker scores, and a submission has waited for {time.time() - queued_since:.0f} s"]
