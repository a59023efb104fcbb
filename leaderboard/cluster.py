"""Scoring on a dask cluster: its workers reach the archives and the dataset by the same URLs and paths."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from leaderboard.jobs import Outcome
from leaderboard.scorer import Score, local_score
from leaderboard.settings import Settings
from rebar_depth_bench.errors import InputError

CONNECT_S = 10


@contextmanager
def cluster_score(settings: Settings) -> Iterator[Score]:
    """Yield scoring that asks a dask worker; raises ``InputError`` where the scheduler does not answer."""
    try:
        from distributed import Client, Future
    except ImportError as error:
        raise InputError(
            f"a cluster needs dask ({error}): pip install 'rebar-depth-bench[server,cluster]'"
        ) from None
    try:
        client = Client(settings.cluster, timeout=CONNECT_S, set_as_default=False)
    except OSError as error:
        raise InputError(f"{settings.cluster}: no dask scheduler answers: {error}") from None
    step_s = settings.lease / 4

    def score(submission_id: str, go_on: Callable[[], bool]) -> Outcome | None:
        future: Future[Any] = client.submit(score_here, settings.model_dump_json(), submission_id, pure=False)
        try:
            while True:
                try:
                    found: Outcome | None = future.result(timeout=step_s)
                    return found
                except TimeoutError:
                    if not go_on():
                        return None
        finally:
            future.cancel()

    with client:
        yield score


def score_here(settings_json: str, submission_id: str) -> Outcome | None:
    """Score a submission on the machine that this runs on, in a process of its own."""
    from leaderboard.archives import Archives

    settings = Settings.model_validate_json(settings_json)
    with tempfile.TemporaryDirectory() as state:
        own = settings.model_copy(update={"state": Path(state)})
        own.spool.mkdir(parents=True)
        return local_score(own, Archives(settings.archives_url))(submission_id, lambda: True)
