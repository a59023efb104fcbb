"""Scoring backend on a dask cluster, whose workers access archives and dataset by the same URLs and paths."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from leaderboard.db.jobs import Job, Outcome
from leaderboard.scoring.subprocess_backend import make_subprocess_backend
from leaderboard.scoring.worker import POLL_INTERVAL_S, RENEWALS_PER_LEASE, BackendUnavailableError, ScoringBackend
from leaderboard.settings import Settings
from rebar_depth_bench.errors import InputError

CONNECT_S = 10


def make_dask_backend(settings: Settings) -> ScoringBackend:
    """Return a backend that scores on a dask worker.

    It connects anew for each job, so that the scheduler may be restarted. Raises ``InputError`` if dask is not
    installed.
    """
    check_dask()
    from distributed import CancelledError, Client, KilledWorker

    worker_settings = settings_for_workers(settings).model_dump_json()
    connect_s = min(CONNECT_S, settings.lease_seconds / 2)  # The lease is not renewed while connecting.
    step_s = min(settings.lease_seconds / RENEWALS_PER_LEASE, POLL_INTERVAL_S)

    def score(job: Job, should_continue: Callable[[], bool]) -> Outcome | None:
        try:
            with Client(settings.dask_scheduler, timeout=connect_s, set_as_default=False) as client:
                return _wait_for_outcome(
                    client.submit(score_on_worker, worker_settings, job, pure=False), step_s, should_continue
                )
        except KilledWorker:
            return None  # Several workers died while scoring it.
        except (Exception, CancelledError) as error:  # Network errors and errors raised on the worker.
            raise BackendUnavailableError(f"{settings.dask_scheduler}: {type(error).__name__}: {error}") from None

    return score


def check_dask() -> None:
    """Raise ``InputError`` if dask is not installed."""
    try:
        import distributed  # noqa: F401
    except ImportError as error:
        raise InputError(
            f"scoring on a cluster requires dask ({error}): pip install 'rebar-depth-bench[server,cluster]'"
        ) from None


def _wait_for_outcome(future: Any, step_s: float, should_continue: Callable[[], bool]) -> Outcome | None:
    try:
        while True:
            try:
                outcome: Outcome | None = future.result(timeout=step_s)
                return outcome
            except TimeoutError:
                if not should_continue():
                    return None
    finally:
        future.cancel()  # A running task continues until its time limit.


def settings_for_workers(settings: Settings) -> Settings:
    """Return the settings for a dask worker: absolute paths, and no database URL, which may hold a password."""
    archives = settings.archives_url
    absolute = {
        "data": str(Path(settings.data).absolute()) if Path(settings.data).is_dir() else settings.data,
        "state_dir": settings.state_dir.absolute(),
        "archives": archives if "://" in archives else str(Path(archives).absolute()),
    }
    return settings.model_copy(update={**absolute, "db": ""})


def score_on_worker(settings_json: str, job: Job) -> Outcome | None:
    """Score a submission in a subprocess of the dask worker, with the settings of ``settings_for_workers``."""
    settings = Settings.model_validate_json(settings_json)
    with tempfile.TemporaryDirectory() as spool:
        return make_subprocess_backend(settings, Path(spool))(job, lambda: True)
