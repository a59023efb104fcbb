"""Service context shared by the routes: settings, dataset, database, archives, limits; and its checks."""

from __future__ import annotations

import shutil
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import structlog
from anyio import CapacityLimiter, Lock
from huggingface_hub.repocard import metadata_load
from sqlalchemy import func, not_, select

from leaderboard.db import jobs
from leaderboard.db.engine import Database
from leaderboard.db.models import SubmissionModel
from leaderboard.db.rankings import CurrentRankings
from leaderboard.db.submissions import QUEUED, SCORING
from leaderboard.settings import Settings
from leaderboard.storage.archive_store import ArchiveStore, delete_abandoned_uploads, make_folder
from rebar_depth_bench.data.manifest import MANIFEST_FILE, DatasetFolder, open_folder
from rebar_depth_bench.names import TEST_SPLIT, config_of

SIMULTANEOUS_CHECKS = 2
MIN_FREE_BYTES = 1 << 30
STALLED_S = 600.0
"""Time without a lease after which a queued submission shows that no worker takes it."""
_LOG = structlog.get_logger("service")


@dataclass(frozen=True)
class Service:
    """Dependencies of the request handlers.

    ``spool`` is the folder for incomplete uploads, ``view_counts`` has the number of views to predict by config.
    """

    settings: Settings
    folder: DatasetFolder
    database: Database
    archives: ArchiveStore
    spool: Path
    rankings: CurrentRankings
    dataset_name: str
    dataset_licence: str
    manifest_state: tuple[int, int] | None
    view_counts: Mapping[str, int]
    workers: list[threading.Thread] = field(default_factory=list)
    """Local workers; filled when they start."""
    upload_locks: defaultdict[int, Lock] = field(default_factory=lambda: defaultdict(Lock))
    """Locks by id of a token, held while an archive is received and checked; used on the event loop only."""
    scenes: dict[str, bytes | None] = field(default_factory=dict)
    """Pictures of configs as WebP, None for a config without colour; filled on request."""
    check_limiter: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(SIMULTANEOUS_CHECKS))


@contextmanager
def open_service(settings: Settings) -> Iterator[Service]:
    """Open the service: migrate the database, and remove abandoned uploads.

    Submissions whose result is of other definitions are scored again if their archive is kept. Raises
    ``InputError`` if the dataset, the database or the archive storage is unusable, and if the leaderboard has
    submissions of another dataset with their archives, unless the setting ``rescore`` is on.
    """
    folder, manifest = open_folder(settings.data), manifest_state(settings.data)
    name, licence = _read_card(settings.data)
    make_folder(settings.spool, "the folder of uploads")
    delete_abandoned_uploads(settings.spool)
    with ExitStack() as stack:
        database = stack.enter_context(
            closing(Database(settings.database_url, hidden_truth=settings.hidden_truth))
        )
        archives = ArchiveStore(settings.archive_dir)
        database.migrate()
        if requeued := jobs.requeue_stale(database, folder.digest, archives.ids(), settings.rescore):
            _LOG.info("results of another dataset or definition; submissions requeued", submissions=requeued)
        yield Service(
            settings=settings,
            folder=folder,
            database=database,
            archives=archives,
            spool=settings.spool,
            rankings=CurrentRankings(database, folder.digest),
            dataset_name=name,
            dataset_licence=licence,
            manifest_state=manifest,
            view_counts=Counter(map(config_of, folder.expected_views(TEST_SPLIT))),
        )


def _read_card(data: str) -> tuple[str, str]:
    """Return name and licence of a dataset; without a card, the name is that of the folder or repository."""
    path = Path(data)
    try:
        card = metadata_load(path / "README.md") or {}
    except (OSError, ValueError):
        card = {}
    name = card.get("pretty_name") or (path.resolve().name if path.is_dir() else data)
    return str(name), str(card.get("license", "not stated"))


def manifest_state(data: str) -> tuple[int, int] | None:
    """Return size and modification time of the manifest of a dataset folder, None if there is no such file."""
    try:
        status = (Path(data) / MANIFEST_FILE).stat()
    except OSError:
        return None
    return status.st_size, status.st_mtime_ns


def service_problems(service: Service) -> list[str]:
    """Return what is wrong with a running service. Raises the errors of an unavailable database."""
    problems = [*_dataset_problems(service), *disk_problem(service.spool)]
    expected, running = service.settings.workers, sum(worker.is_alive() for worker in service.workers)
    if running < expected:
        problems.append(f"{running} of {expected} local workers are running")
    return problems + queue_problems(service.database)


def _dataset_problems(service: Service) -> list[str]:
    """Return whether the dataset folder is gone or its manifest was replaced; a Hub dataset is not checked."""
    found = manifest_state(service.settings.data)
    if found == service.manifest_state:
        return []
    return [
        "the manifest of the dataset " + ("cannot be read" if found is None else "has changed since the start")
    ]


def disk_problem(folder: Path, name: str = "the state folder") -> list[str]:
    """Return whether the disk of a folder is nearly full."""
    free = shutil.disk_usage(folder).free
    return [] if free >= MIN_FREE_BYTES else [f"the disk of {name} has {free >> 20} MiB left"]


def queue_problems(database: Database) -> list[str]:
    """Return whether the oldest queued submission waits although no submission is being scored."""
    oldest = select(func.min(SubmissionModel.created_at)).where(SubmissionModel.status == QUEUED)
    active = select(func.count()).where(SubmissionModel.status == SCORING, not_(jobs.is_free(time.time())))
    with database.read() as session:
        queued_since, scoring = session.scalar(oldest), session.scalar(active)
    if queued_since is None or scoring or time.time() - queued_since < STALLED_S:
        return []
    return [f"no worker scores, and a submission has waited for {time.time() - queued_since:.0f} s"]
