"""A scorer as a process: settings as JSON on standard input; SIGTERM gives the job at hand back and ends it."""

from __future__ import annotations

import signal
import sys
import threading
from contextlib import closing
from pathlib import Path

from leaderboard.archives import Archives
from leaderboard.database import Database
from leaderboard.limits import die_with_parent
from leaderboard.logs import set_up_logs
from leaderboard.scorer import Score, local_score, work
from leaderboard.settings import Settings
from leaderboard.spool import own_spool
from rebar_depth_bench.console import run_command


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
    with own_spool(settings.spool) as spool, closing(Database(settings.database_url)) as database:
        database.migrate()
        work(database, settings, _score(settings, spool), stop)


def _score(settings: Settings, spool: Path) -> Score:
    if not settings.cluster:
        return local_score(settings, Archives(settings.archives_url), spool)
    from leaderboard.cluster import cluster_score

    return cluster_score(settings)


if __name__ == "__main__":
    sys.exit(main())
