"""Boards that are filled without a server, kills of their operations, and the state that they must keep."""

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
from leaderboard.db.submissions import Quota, Upload, archive_rows
from leaderboard.db.tokens import create_token, find_token
from leaderboard.scoring.sandbox import Outcome
from leaderboard.settings import Settings, read_settings
from leaderboard.storage.archive_store import ArchiveStore
from rebar_depth_bench.submission import SubmissionMeta
from tests.bench.reporting.results import result, scored_view

DIGEST, OTHER_DIGEST = "sha256:" + "0" * 64, "sha256:" + "1" * 64
_PROCESSES = multiprocessing.get_context("forkserver")
_OPERATIONS = ("os.rename", "os.remove", "os.chmod", "shutil.copyfile", "sqlite3.connect")
"""Audit events of changes of a folder; Python reports ``replace`` as ``rename``, and ``unlink`` as ``remove``."""


def board_settings(state: Path, **values: object) -> Settings:
    return read_settings(None, {"data": "", "state_dir": state, **values})


@contextmanager
def opened(settings: Settings) -> Iterator[tuple[Database, ArchiveStore]]:
    """Yield database and archives of a board, which is made if there is none."""
    settings.state_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
    with closing(Database(settings.database_url)) as database:
        database.migrate()
        yield database, ArchiveStore(settings.archive_dir)


def make_board(settings: Settings) -> str:
    """Make a board, and return a token of it."""
    with opened(settings) as (database, _):
        return create_token(database, "alice")


def add_submission(settings: Settings, token: str, content: bytes, *, scored: bool = True) -> str:
    """Add a submission whose archive is ``content``, as a server and a worker do; return its id."""
    with opened(settings) as (database, archives):
        record = find_token(database, token)
        assert record is not None
        submission_id = submissions.new_id()
        file = settings.state_dir / f"{submission_id}.upload"
        file.touch(0o600)
        file.write_bytes(content)
        archives.put(submission_id, file)
        upload = Upload(SubmissionMeta(method="m"), hashlib.sha256(content).hexdigest(), len(content), DIGEST)
        submissions.accept(database, submission_id, record, upload, Quota(10_000, 1 << 40), True)
        if scored:
            score_all(database)
    return submission_id


def result_bytes(dataset_digest: str) -> bytes:
    document = result(scored_view("lattice/0000"), method="m").to_dict()
    document["dataset"]["digest"] = dataset_digest
    return json.dumps(document).encode()


def score_all(database: Database) -> None:
    """Score what is queued."""
    while submission_id := jobs.claim(database, "scorer", 1e-6):
        record = submissions.find(database, submission_id)
        assert record is not None
        jobs.finish(database, submission_id, "scorer", Outcome(result_bytes(record.dataset_digest)))


def facts(settings: Settings) -> dict[str, tuple[str, str, str | None, bool]]:
    """Return status, dataset, digest of the stored result's dataset, and presence of the archive by submission."""
    with closing(Database(settings.database_url, read_only=True)) as database, database.read() as session:
        rows = session.execute(
            select(SubmissionModel, ResultModel.json).outerjoin(
                ResultModel, ResultModel.submission_id == SubmissionModel.id
            )
        )
        return {
            row.id: (
                row.status,
                row.dataset_digest,
                None if content is None else json.loads(content)["dataset"]["digest"],
                (settings.archive_dir / f"{row.id}.zip").is_file(),
            )
            for row, content in rows
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
