"""Fixtures of the tests of the leaderboard's client: an archive, its result, and a scripted server."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from rebar_depth_bench import score
from rebar_depth_bench.remote import leaderboard_client
from tests.leaderboard.client.requests import TOKEN, TOKEN_INFO, submission
from tests.leaderboard.client.scripted_server import ScriptedServer, answer, scripted_server
from tests.leaderboard.conftest import WriteArchive


@pytest.fixture(scope="module")
def archive(write_archive: WriteArchive) -> Path:
    return write_archive("scripted", configs=("lattice-orbit",))


@pytest.fixture(scope="module")
def result_json(archive: Path, tiny_root: Path) -> bytes:
    return score(archive, tiny_root).to_json()


@pytest.fixture
def server(archive: Path, result_json: bytes, monkeypatch: pytest.MonkeyPatch) -> Iterator[ScriptedServer]:
    """Run a server that accepts and scores the archive; tests replace its answers."""
    monkeypatch.setattr(leaderboard_client, "POLL_INTERVAL_S", 0.01)
    monkeypatch.setenv("REBAR_LEADERBOARD_TOKEN", TOKEN)
    with scripted_server() as script:
        script.answers = {
            "token": [answer(TOKEN_INFO)],
            "submit": [answer(submission(archive), 202)],
            "status": [answer(submission(archive)), answer(submission(archive, status="scored"))],
            "result": [answer(result_json)],
        }
        yield script
