"""Leaderboards that are filled without a server, kills of their operations, and the state that they must keep."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from sqlalchemy import Engine, event, select

from leaderboard.db import jobs, submissions
from leaderboard.db.engine import Database
from leaderboard.db.models import ResultModel, SubmissionModel
from leaderboard.db.submissions import QUEUED, archive_rows
from leaderboard.db.tokens import create_token, find_token
from leaderboard.scoring.sandbox import Outcome
from leaderboard.settings import Settings, read_settings
from leaderboard.storage.archive_store import ArchiveStore
from tests.bench.reporting.results import result, scored_view

DIGEST, OTHER_DIGEST = "sha256:" + "0" * 64, "sha256:" + "1" * 64
_PROCESSES = multiprocessing.get_context("forkserver")
_OPERATIONS = ("os.rename", "os.remove", "os.chmod", "shutil.copyfile", "sqlite3.connect")
"""Audit events of changes of a folder; Python reports ``replace`` as ``rename``, and ``unlink`` as ``remove``."""


def board_settings(state: Path, **values: object) -> Settings:
    return read_settings(None, {"data": "", "state_dir": state, **values})


@contextmanager
def opened(settings: Settings) -> Iterator[tuple[Database, ArchiveStore]]:
    """Yield database and archives of a leaderboard, which is made if there is none."""
    settings.state_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
    with closing(Database(settings.database_url)) as database:
        database.create_schema()
        archives = ArchiveStore(settings.archive_dir, database.board().board_id)
        archives.initialise(archive_rows(database))
        yield database, archives


def make_board(settings: Settings) -> str:
    """Make a leaderboard that serves the dataset with ``DIGEST``, and return a token of it."""
    with opened(settings) as (database, _):
        jobs.serve_dataset(database, DIGEST, rescore=False)
        return create_token(database, "alice")


def accept(
    database: Database, token: str, *, method: str = "m", sha256: str = "", size: int = 5, public: bool = True
) -> str:
    """Insert a queued submission, as a server does; return its id."""
    record = find_token(database, token)
    assert record is not None
    submission_id = submissions.new_id()
    with database.write() as session:
        session.add(
            SubmissionModel(
                id=submission_id,
                token_id=record.id,
                method=method,
                details="{}",
                archive_sha256=sha256 or submission_id * 2,
                archive_bytes=size,
                public=public,
                created_at=time.time(),
                queued_at=time.time(),
                status=QUEUED,
                attempts=0,
            )
        )
    return submission_id


def claimed(database: Database, scorer: str, lease_s: float = 60) -> str | None:
    """Claim a job; return its id."""
    record = jobs.claim(database, scorer, lease_s)
    return None if record is None else record.id


def add_submission(settings: Settings, token: str, content: bytes, *, scored: bool = True) -> str:
    """Add a submission whose archive is ``content``, as a server and a worker do; return its id."""
    with opened(settings) as (database, archives):
        file = settings.state_dir / "one.upload"
        file.touch(0o600)
        file.write_bytes(content)
        sha256 = hashlib.sha256(content).hexdigest()
        submission_id = accept(database, token, sha256=sha256, size=len(content))
        archives.put(submission_id, file)
        if scored:
            score_all(database)
    return submission_id


def result_bytes(dataset_digest: str) -> bytes:
    document = result(scored_view("lattice/0000"), method="m").to_dict()
    document["dataset"]["digest"] = dataset_digest
    return json.dumps(document).encode()


def score_all(database: Database) -> None:
    """Score what is queued against the served dataset."""
    digest = database.board().dataset_digest
    assert digest is not None
    while submission_id := claimed(database, "scorer", 1e-6):
        jobs.finish(database, submission_id, "scorer", Outcome(digest, result_bytes(digest)))


def facts(settings: Settings) -> dict[str, tuple[str, frozenset[str], bool]]:
    """Return status, digests of the datasets of the stored results, and presence of the archive by submission."""
    with closing(Database(settings.database_url, read_only=True)) as database, database.read() as session:
        results = list(session.execute(select(ResultModel.submission_id, ResultModel.json)))
        of_results: dict[str, set[str]] = {}
        for submission_id, content in results:
            if content is not None:
                of_results.setdefault(submission_id, set()).add(json.loads(content)["dataset"]["digest"])
        return {
            row.id: (
                row.status,
                frozenset(of_results.get(row.id, ())),
                (settings.archive_dir / f"{row.id}.zip").is_file(),
            )
            for row in session.scalars(select(SubmissionModel))
        }


def assert_sound(settings: Settings) -> None:
    """Check that the database is whole, and that every archive that a row needs is there and is the right one."""
    with closing(Database(settings.database_url, read_only=True)) as database:
        database.check_schema()
        assert database.problems() == []
        for submission_id, row in archive_rows(database).items():
            if row is not None:
                content = (settings.archive_dir / f"{submission_id}.zip").read_bytes()
                assert (hashlib.sha256(content).hexdigest(), len(content)) == row


def killed(kill_at: int, operation: Callable[..., object], *arguments: object) -> bool:
    """Run an operation in a process that is killed before its ``kill_at``-th commit or change of a folder.

    Returns False if it has ended before.
    """
    process = _PROCESSES.Process(target=_run, args=(kill_at, operation, *arguments))
    process.start()
    process.join(120)
    assert process.exitcode in (0, -signal.SIGKILL), process.exitcode
    return process.exitcode != 0


def _run(kill_at: int, operation: Callable[..., object], *arguments: Any) -> None:
    left = kill_at

    def count(name: str, *_: object) -> None:
        nonlocal left
        if name in _OPERATIONS:
            left -= 1
            if left == 0:
                os.kill(os.getpid(), signal.SIGKILL)
                time.sleep(60)

    event.listen(Engine, "commit", lambda _: count("os.rename"))
    sys.addaudithook(count)
    operation(*arguments)


_PROCESSES.set_forkserver_preload([__name__])
