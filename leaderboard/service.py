"""Service context shared by the routes: settings, dataset, database, archive storage, upload limits, metrics."""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import structlog
from anyio import CapacityLimiter, Lock
from huggingface_hub.repocard import metadata_load
from sqlalchemy import select

from leaderboard.db import jobs
from leaderboard.db.engine import Database
from leaderboard.db.models import SubmissionModel
from leaderboard.db.submissions import DELETED
from leaderboard.db.versions import CurrentRankings, VersionReader
from leaderboard.metrics import ServiceMetrics
from leaderboard.scoring.supervisor import WorkerSupervisor
from leaderboard.settings import Settings
from leaderboard.storage.archive_store import ArchiveStore
from leaderboard.storage.work_dirs import work_dir
from rebar_depth_bench.data.manifest import MANIFEST_FILE, DatasetFolder, open_folder
from rebar_depth_bench.errors import InputError
from rebar_depth_bench.view_ids import TEST_SPLIT, config_of

ORPHAN_AGE_S = 3600.0
"""Age in seconds after which an archive without a submission is regarded as an interrupted upload."""
SIMULTANEOUS_CHECKS = 2
_LOG = structlog.get_logger("service")


@dataclass(frozen=True)
class DatasetCard:
    """Name and licence of the dataset as its card states them."""

    name: str
    licence: str


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
    metrics: ServiceMetrics
    supervisor: WorkerSupervisor
    versions: VersionReader
    rankings: CurrentRankings
    card: DatasetCard
    manifest_state: tuple[int, int] | None
    view_counts: Mapping[str, int]
    upload_locks: defaultdict[int, Lock] = field(default_factory=lambda: defaultdict(Lock))
    """Locks by id of a token, held while an archive is received and checked; used on the event loop only."""
    scenes: dict[str, bytes | None] = field(default_factory=dict)
    """Pictures of configs as WebP, None for a config without colour; filled on request."""
    check_limiter: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(SIMULTANEOUS_CHECKS))


@contextmanager
def open_service(settings: Settings) -> Iterator[Service]:
    """Open the service: migrate the database and remove orphaned archives.

    Submissions whose result is of another protocol are scored again if their archive is kept. Raises
    ``InputError`` if the dataset, the database or the archive storage is unusable, and if the leaderboard has
    submissions of another dataset, unless the setting ``rescore`` is on.
    """
    folder, manifest = open_folder(settings.data), manifest_state(settings.data)
    card = read_card(settings.data)
    with ExitStack() as stack:
        spool = stack.enter_context(work_dir(settings.spool))
        database = stack.enter_context(
            closing(Database(settings.database_url, hidden_truth=settings.hidden_truth))
        )
        archives = ArchiveStore(settings.archive_dir)
        database.migrate()
        remove_orphan_archives(database, archives)
        _check_dataset_unchanged(folder, database, settings.rescore)
        if requeued := jobs.requeue_other_protocols(database, archives.ids()):
            _LOG.info("results of another protocol; submissions requeued", submissions=requeued)
        versions = stack.enter_context(closing(VersionReader(database)))
        yield Service(
            settings=settings,
            folder=folder,
            database=database,
            archives=archives,
            spool=spool,
            metrics=ServiceMetrics(database),
            supervisor=WorkerSupervisor(settings, settings.workers),
            versions=versions,
            rankings=CurrentRankings(database, versions),
            card=card,
            manifest_state=manifest,
            view_counts=Counter(map(config_of, folder.expected_views(TEST_SPLIT))),
        )


def read_card(data: str) -> DatasetCard:
    """Return what the card of a dataset says; without a card, its name is that of the folder or repository."""
    path = Path(data)
    try:
        values = metadata_load(path / "README.md") or {}
    except (OSError, ValueError):
        values = {}
    name = values.get("pretty_name") or (path.resolve().name if path.is_dir() else data)
    return DatasetCard(str(name), str(values.get("license", "not stated")))


def manifest_state(data: str) -> tuple[int, int] | None:
    """Return size and modification time of the manifest of a dataset folder, None if there is no such file."""
    try:
        status = (Path(data) / MANIFEST_FILE).stat()
    except OSError:
        return None
    return status.st_size, status.st_mtime_ns


def _check_dataset_unchanged(folder: DatasetFolder, database: Database, rescore: bool) -> None:
    """Ensure that all submissions belong to the dataset ``folder``, so that results never mix two datasets.

    Submissions of other datasets are requeued if ``rescore`` is True; otherwise raises ``InputError``.
    """
    stale = jobs.count_stale_submissions(database, folder.digest)
    if stale and not rescore:
        raise InputError(
            f"{folder.root}: the dataset digest is {folder.digest}, but {stale} submissions of this leaderboard "
            "belong to another dataset; use --rescore true to score them against this one"
        )
    jobs.requeue_stale_submissions(database, folder.digest)


def remove_orphan_archives(database: Database, archives: ArchiveStore) -> None:
    """Delete archives without a submission, except recent ones, whose row may not be inserted yet.

    Nothing is deleted if the database has no submissions, since it is probably not the one of these archives.
    """
    now = time.time()
    with database.read() as session:
        rows = session.execute(select(SubmissionModel.id, SubmissionModel.status)).all()
    orphans = archives.ids() - {submission_id for submission_id, status in rows if status != DELETED}
    if orphans and not rows:
        _LOG.warning("orphan cleanup skipped", reason="the database has no submissions", archives=len(orphans))
        return
    for submission_id in orphans:
        if archives.age_s(submission_id, now) > ORPHAN_AGE_S:
            archives.delete(submission_id)
            _LOG.info("orphaned archive deleted", archive=submission_id[:6])
