"""Entry point of a worker process, which reads its settings as JSON from standard input.

On SIGTERM the current job is requeued and the process exits.
"""

from __future__ import annotations

import signal
import sys
import threading
from contextlib import closing

import structlog

from leaderboard.db.engine import Database, sqlite_path
from leaderboard.log_setup import set_up_logs
from leaderboard.redact import without_password
from leaderboard.scoring.process_limits import die_with_parent
from leaderboard.scoring.worker import process_queue
from leaderboard.settings import Settings
from leaderboard.storage.work_dirs import work_dir
from rebar_depth_bench.console import run_command
from rebar_depth_bench.errors import InputError
from rebar_depth_bench.version import software_version

_LOG = structlog.get_logger("worker")


def main() -> int:
    """Run a worker until it is stopped. The command-line argument is the id of the parent process, a server."""
    die_with_parent(int(sys.argv[1]))
    set_up_logs()
    settings = Settings.model_validate_json(sys.stdin.read())
    return run_command(lambda: run_worker(settings, migrate=False))


def run_worker(settings: Settings, *, migrate: bool) -> None:
    """Score queued submissions until SIGTERM or SIGINT.

    ``migrate`` upgrades the schema first, which the server has done for its own workers.

    Raises ``InputError`` if the SQLite database does not exist.
    """
    stop = threading.Event()
    for signal_number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(signal_number, lambda *_: stop.set())
    url = settings.database_url
    path = sqlite_path(url)
    if path is not None and not path.is_file():
        raise InputError(f"{url}: the database does not exist, expected the database of a server")
    with work_dir(settings.spool) as spool, closing(Database(url)) as database:
        if migrate:
            database.migrate()
        _LOG.info("waiting for submissions", database=without_password(url), version=software_version())
        process_queue(database, settings, spool, stop)


if __name__ == "__main__":
    sys.exit(main())
