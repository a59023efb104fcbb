"""Scoring on a dask cluster: its workers reach the archives and the dataset by the same URLs and paths."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from leaderboard.db.jobs import Job, Outcome
from leaderboard.scoring.subprocess_backend import local_score
from leaderboard.scoring.worker import IDLE_S, RENEWALS_PER_LEASE, AwayError, Score
from leaderboard.settings import Settings
from rebar_depth_bench.errors import InputError

CONNECT_S = 10


def cluster_score(settings: Settings) -> Score:
    """Return scoring that asks a dask worker, with a connection for each job: a scheduler may come and go.

    Raises ``InputError`` where dask is not installed.
    """
    check_dask()
    from distributed import CancelledError, Client, KilledWorker

    told = settings_for_workers(settings).model_dump_json()
    connect_s = min(CONNECT_S, settings.lease / 2)  # nobody renews the lease meanwhile
    step_s = min(settings.lease / RENEWALS_PER_LEASE, IDLE_S)

    def score(job: Job, go_on: Callable[[], bool]) -> Outcome | None:
        try:
            with Client(settings.cluster, timeout=connect_s, set_as_default=False) as client:
                return _await(client.submit(score_here, told, job, pure=False), step_s, go_on)
        except KilledWorker:
            return None  # several workers died of it
        except (Exception, CancelledError) as error:  # the network's, and what a worker lacks
            raise AwayError(f"{settings.cluster}: {type(error).__name__}: {error}") from None

    return score


def check_dask() -> None:
    """Raise ``InputError`` where dask is not installed."""
    try:
        import distributed  # noqa: F401
    except ImportError as error:
        raise InputError(
            f"a cluster needs dask ({error}): pip install 'rebar-depth-bench[server,cluster]'"
        ) from None


def _await(future: Any, step_s: float, go_on: Callable[[], bool]) -> Outcome | None:
    try:
        while True:
            try:
                outcome: Outcome | None = future.result(timeout=step_s)
                return outcome
            except TimeoutError:
                if not go_on():
                    return None
    finally:
        future.cancel()  # what runs already goes on, bounded by its time


def settings_for_workers(settings: Settings) -> Settings:
    """Return what a worker has to know: paths from the root, for it runs elsewhere, and no database's password."""
    archives = settings.archives_url
    places = {
        "data": str(Path(settings.data).absolute()) if Path(settings.data).is_dir() else settings.data,
        "state": settings.state.absolute(),
        "archives": archives if "://" in archives else str(Path(archives).absolute()),
    }
    return settings.model_copy(update={**places, "db": ""})


def score_here(settings_json: str, job: Job) -> Outcome | None:
    """Score a submission on the machine that this runs on, in a process of its own."""
    settings = Settings.model_validate_json(settings_json)
    with tempfile.TemporaryDirectory() as spool:
        return local_score(settings, Path(spool))(job, lambda: True)
