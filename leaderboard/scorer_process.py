"""A scorer as a process: settings as JSON on standard input; SIGTERM gives the job at hand back and ends it."""

from __future__ import annotations

import signal
import sys
import threading

from leaderboard.archives import Archives
from leaderboard.database import Database
from leaderboard.limits import die_with_parent
from leaderboard.logs import set_up_logs
from leaderboard.scorer import local_score, work
from leaderboard.settings import Settings


def main() -> int:
    """Score until told to stop."""
    die_with_parent()
    set_up_logs()
    run_scorer(Settings.model_validate_json(sys.stdin.read()))
    return 0


def run_scorer(settings: Settings) -> None:
    """Score what waits, here or on a cluster, until SIGTERM or SIGINT."""
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    settings.spool.mkdir(parents=True, exist_ok=True)
    database, archives = Database(settings.database_url), Archives(settings.archives_url)
    try:
        if settings.cluster:
            from leaderboard.cluster import cluster_score

            with cluster_score(settings) as score:
                work(database, settings, score, stop)
        else:
            work(database, settings, local_score(settings, archives), stop)
    finally:
        database.close()


if __name__ == "__main__":
    sys.exit(main())
