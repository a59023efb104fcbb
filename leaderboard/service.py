"""Service context shared by the routes: settings, dataset, database, archives, limits."""

from __future__ import annotations

import threading
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import structlog
from anyio import CapacityLimiter, Lock
from huggingface_hub.repocard import metadata_load

from leaderboard.db import jobs
from leaderboard.db.engine import Database
from leaderboard.db.rankings import CurrentRankings
from leaderboard.db.submissions import archive_rows
from leaderboard.settings import Settings
from leaderboard.storage.archive_store import ArchiveStore, delete_abandoned_uploads, make_folder
from rebar_depth_bench.base.errors import StorageError
from rebar_depth_bench.base.names import TEST_SPLIT, config_of
from rebar_depth_bench.data.files import MANIFEST_FILE
from rebar_depth_bench.data.manifest import DatasetFolder, open_folder

SIMULTANEOUS_CHECKS = 2
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
    """Open the service.

    The tables of an empty database are created, abandoned uploads deleted, and what is to be scored again queued.
    If the archive folder is not that of the database, reading works, uploads are refused, and jobs wait. Raises
    ``InputError`` if the dataset or the database is unusable, and if the leaderboard has submissions of another
    dataset with their archives, unless the setting ``rescore`` is on.
    """
    folder, manifest = open_folder(settings.data), manifest_state(settings.data)
    name, licence = _read_card(settings.data)
    make_folder(settings.spool, "the folder of uploads")
    delete_abandoned_uploads(settings.spool)
    with closing(Database(settings.database_url)) as database:
        database.create_schema()
        archives = ArchiveStore(settings.archive_dir, database.board().board_id)
        rows = archive_rows(database)
        archives.initialise(rows)
        try:
            archives.finish_deletions(rows)
        except (StorageError, OSError) as error:
            _LOG.error("the archive folder is unusable; uploads are refused, and jobs wait", error=str(error))
        if requeued := jobs.serve_dataset(database, folder.digest, settings.rescore):
            _LOG.info("results of another dataset or protocol; submissions queued", submissions=requeued)
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
