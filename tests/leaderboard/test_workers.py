"""Workers and servers that are stopped or superseded while submissions wait."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from leaderboard.db import jobs
from leaderboard.uploads import UNAVAILABLE_MESSAGE
from tests.leaderboard.boards import OTHER_DIGEST, board_settings, opened
from tests.leaderboard.serving import SCORING, RunServer
from tests.processes import processes_below, wait_until


@pytest.mark.parametrize("signal_number", [signal.SIGINT, signal.SIGTERM])
def test_signal_to_all_processes_requeues_the_job(
    small_archive: Path, running_server: RunServer, signal_number: signal.Signals
) -> None:
    """A terminal and systemd signal the process that scores too. It may have ended just before."""
    with running_server() as server:
        submission = server.submit_accepted(small_archive, server.token("alice"))
        wait_until(lambda: processes_below(server.process.pid, SCORING), "scoring begins")
        for pid in (*processes_below(server.process.pid, SCORING), server.process.pid):
            os.kill(pid, signal_number)
        assert server.process.wait(30) == 0
    row = server.row(submission)
    assert (row["status"], row["attempts"], row["reason"]) in (("queued", 0, None), ("scored", 1, None))


def test_server_of_a_dataset_that_is_no_longer_served_accepts_nothing(
    small_archive: Path, running_server: RunServer
) -> None:
    with running_server(workers=0) as server:
        token = server.token("alice")
        with opened(board_settings(server.state)) as (database, _):
            jobs.serve_dataset(database, OTHER_DIGEST, rescore=True)
        response = server.submit(small_archive, token)
        assert (response.status_code, response.json()["detail"]) == (503, UNAVAILABLE_MESSAGE)
        assert f"serves the dataset {OTHER_DIGEST}" in server.get("/healthz").text
        assert list((server.state / "archives").glob("*.zip")) == []
