"""Commands of operators: tokens, submissions, prune, check."""

from __future__ import annotations

import csv
import io
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import httpx2
import pytest

from tests.leaderboard.conftest import WriteArchive
from tests.leaderboard.serving import RunServer, Server


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "leaderboard", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def table(process: subprocess.CompletedProcess[str]) -> list[dict[str, str]]:
    assert process.returncode == 0, process.stderr
    return list(csv.DictReader(io.StringIO(process.stdout)))


@pytest.fixture(scope="module")
def server(
    tiny_root: Path,
    tmp_path_factory: pytest.TempPathFactory,
    running_server: RunServer,
) -> Iterator[Server]:
    state = tmp_path_factory.mktemp("operations") / "state"
    with running_server(tiny_root, state, default_visibility="owner") as started:
        yield started


@pytest.fixture(scope="module")
def scored(server: Server, write_archive: WriteArchive) -> dict[str, str]:
    """Return the ids of three scored submissions by their method, of which two are public."""
    token = server.token("alice")
    scales = {"best": 1.0, "middle": 1.2, "worst": 2.0}
    ids = {
        name: server.submit_accepted(write_archive(name, scale, configs=("lattice-orbit",)), token)
        for name, scale in scales.items()
    }
    for submission_id in ids.values():
        assert server.wait_until_ended(submission_id)["status"] == "scored"
    for name in ("best", "worst"):
        address, headers = f"{server.url}/api/v1/submissions/{ids[name]}", {"Authorization": f"Bearer {token}"}
        assert httpx2.patch(address, json={"public": True}, headers=headers).status_code == 200
    return ids


def test_tokens_and_submissions_are_listed(server: Server, scored: dict[str, str], tiny_root: Path) -> None:
    assert run("token", "eve", "--state-dir", server.state).returncode == 0
    assert run("token", "eve", "--revoke", "--state-dir", server.state).returncode == 0
    tokens = {row["name"]: row for row in table(run("tokens", "--state-dir", server.state))}
    assert (tokens["alice"]["submissions"], tokens["alice"]["revoked"]) == ("3", "")
    assert int(tokens["alice"]["bytes"]) > 0
    assert tokens["eve"]["revoked"].startswith("20")
    rows = {row["method"]: row for row in table(run("submissions", "--state-dir", server.state))}
    assert {name: (row["id"], row["public"]) for name, row in rows.items()} == {
        "best": (scored["best"], "true"),
        "middle": (scored["middle"], "false"),
        "worst": (scored["worst"], "true"),
    }
    process = run("check", "--state-dir", server.state, "--data", tiny_root)
    assert process.returncode == 0, process.stderr
    assert "are in order" in process.stdout


def test_prune_deletes_old_archives_but_not_the_best(
    server: Server, scored: dict[str, str], tiny_root: Path
) -> None:
    with closing(sqlite3.connect(server.state / "leaderboard.sqlite")) as connection:
        connection.execute("UPDATE submissions SET created_at = ?", (time.time() - 10 * 86400,))
        connection.commit()
    options = ("--state-dir", server.state, "--data", tiny_root)
    assert run("prune", *options).returncode == 2
    assert run("prune", *options, "--archive-days", "20").stdout == ""
    limits = ("--archive-days", "5", "--archive-ranks", "1")
    expected = {scored["middle"], scored["worst"]}
    assert set(run("prune", *options, *limits, "--dry-run").stdout.split()) == expected
    archives = server.state / "archives"
    assert {path.stem for path in archives.iterdir()} >= expected
    assert set(run("prune", *options, *limits).stdout.split()) == expected
    assert {path.stem for path in archives.iterdir()} == {scored["best"]}
    assert run("prune", *options, *limits).stdout == ""
    shown = server.wait_until_ended(scored["worst"])
    assert (shown["status"], shown["archive_kept"]) == ("scored", False)
    assert run("check", *options).returncode == 0


def test_check_names_everything_that_is_wrong(server: Server, scored: dict[str, str], tiny_root: Path) -> None:
    archive = server.state / "archives" / f"{scored['best']}.zip"
    archive.rename(archive.with_suffix(".away"))
    process = run("check", "--state-dir", server.state, "--data", tiny_root)
    archive.with_suffix(".away").rename(archive)
    assert process.returncode == 2
    assert f"the archive of submission {scored['best']} is missing" in process.stderr


def test_permissive_state_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "state").mkdir(mode=0o755)
    process = run("tokens", "--state-dir", tmp_path / "state")
    assert process.returncode == 2
    assert "has mode 0755, expected 0700" in process.stderr
