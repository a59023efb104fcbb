"""A scorer as a process: settings as JSON on standard input; SIGTERM gives the job at hand back and ends it."""

from __future__ import annotations

import signal
import sys
import threading
from contextlib import closing
from pathlib import Path

import structlog

from leaderboard.db.engine import Database
from leaderboard.log_setup import set_up_logs
from leaderboard.redact import without_password
from leaderboard.scoring.process_limits import die_with_parent
from leaderboard.scoring.subprocess_backend import local_score
from leaderboard.scoring.worker import Score, work
from leaderboard.settings import Settings
from leaderboard.storage.work_dirs import own_spool
from rebar_depth_bench.cli.console import run_command
from rebar_depth_bench.errors import InputError
from rebar_depth_bench.version import software_version

_LOG = structlog.get_logger("scorer")


def main() -> int:
    """Score until told to stop; the argument is the process that started this one."""
    die_with_parent(int(sys.argv[1]))
    set_up_logs()
    settings = Settings.model_validate_json(sys.stdin.read())
    return run_command(lambda: run_scorer(settings))


def run_scorer(settings: Settings) -> None:
    """Score what waits, here or on a cluster, until SIGTERM or SIGINT."""
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    url = settings.database_url
    if url.startswith("sqlite:///") and not Path(url.removeprefix("sqlite:///")).is_file():
        raise InputError(f"{url}: there is no database, expected that of a server")
    with own_spool(settings.spool) as spool, closing(Database(url)) as database:
        database.migrate()
        _LOG.info("waiting for submissions", database=without_password(url), version=software_version())
        work(database, settings, _score(settings, spool), stop)


def _score(settings: Settings, spool: Path) -> Score:
    if not settings.cluster:
        return local_score(settings, spool)
    from leaderboard.scoring.dask_backend import cluster_score

    return cluster_score(settings)


if __name__ == "__main__":
    sys.exit(main())
