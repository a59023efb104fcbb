"""Leaderboards with results of the previous protocol: migration, rescoring and pages."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import httpx2
import pytest
from sqlalchemy import MetaData, create_engine, insert, update

from leaderboard.settings import Settings
from rebar_depth_bench import score
from rebar_depth_bench.data.manifest import open_folder
from tests.leaderboard.old_schema import create_old_schema
from tests.leaderboard.serving import RunServer
from tests.synthetic_dataset import write_archive, write_dataset

KEPT, LOST, UNKNOWN = "a" * 32, "b" * 32, "c" * 32


def old_result(archive: Path, root: Path) -> dict[str, Any]:
    """Return the result of an archive as the previous protocol had it."""
    document: dict[str, Any] = json.loads(score(archive, root).to_json())
    document["protocol"] = "rebar-1"
    for key in ("inputs", "uses_ground_truth"):
        del document["submission"][key]
    for table in document["tables"].values():
        del table["rank_error"], table["reference"], table["ci95"]["rank_error"]
    for view in document["views"]:
        del view["rank_error"]
    return document


def write_old_database(url: str, digest: str, results: dict[str, dict[str, Any]]) -> None:
    """Write a database of the first schema with one scored submission per result."""
    engine = create_engine(url)
    with engine.begin() as connection:
        create_old_schema(connection, "0001")
        tables = MetaData()
        tables.reflect(connection)
        token = {"id": 1, "name": "alice", "sha256": "0" * 64, "created_at": 0.0}
        connection.execute(insert(tables.tables["tokens"]), token)
        for submission_id, document in results.items():
            record = {
                "id": submission_id,
                "token_id": 1,
                "method": submission_id[:3],
                "uses_intrinsics": True,
                "archive_sha256": "0" * 64,
                "archive_bytes": 1,
                "status": "scored",
                "public": True,
                "created_at": 1.0,
                "finished_at": 2.0,
                "attempts": 1,
                "dataset_digest": digest,
            }
            connection.execute(insert(tables.tables["submissions"]), record)
            content = {"submission_id": submission_id, "json": json.dumps(document).encode()}
            connection.execute(insert(tables.tables["results"]), content)
            for name, table in document["tables"].items():
                row = {"submission_id": submission_id, "config": name, "ranked": True, "json": json.dumps(table)}
                abs_rel = table["native"]["abs_rel"]
                connection.execute(insert(tables.tables["board_rows"]), {**row, "abs_rel": abs_rel})
    engine.dispose()


@pytest.mark.slow
def test_old_results_are_rescored_if_their_archive_is_kept(
    tmp_path: Path, running_server: RunServer, new_database: Callable[[], str]
) -> None:
    root, state, archive = tmp_path / "root", tmp_path / "state", tmp_path / "archive.zip"
    write_dataset(root, ["lattice"], 3)
    write_archive(archive, ["lattice"], 3, "m", 1)
    db = new_database()
    settings = Settings(data=str(root), state_dir=state, db=db)  # type: ignore[call-arg]
    state.mkdir(mode=0o700)
    write_old_database(
        settings.database_url,
        open_folder(root).digest,
        dict.fromkeys((KEPT, LOST, UNKNOWN), old_result(archive, root)),
    )
    (state / "archives").mkdir()
    shutil.copy(archive, state / "archives" / f"{KEPT}.zip")
    with running_server(root, state, db=db) as server:
        result = server.wait_until_ended(KEPT)["result"]
        assert result == json.loads(score(archive, root).to_json())
        rows = httpx2.get(f"{server.url}/api/v1/leaderboard?config=lattice", timeout=60).json()["rows"]
        assert {row["id"]: row["rank"] for row in rows} == {KEPT: 1, LOST: None, UNKNOWN: None}
        text = httpx2.get(f"{server.url}/?config=lattice", timeout=60).text
        assert "a result of rebar-1, which has no rank error" in text
        page = httpx2.get(f"{server.url}/submissions/{LOST}", timeout=60)
        assert page.status_code == 200
        assert "of protocol rebar-1" in page.text
        table = httpx2.get(f"{server.url}/api/v1/leaderboard.csv?config=lattice", timeout=60)
        assert (table.status_code, len(table.text.splitlines())) == (200, 4)
    engine = create_engine(settings.database_url)
    with closing(engine.connect()) as connection, connection.begin():
        tables = MetaData()
        tables.reflect(connection)
        results = tables.tables["results"]
        other = {"protocol": "rebar-9", "json": b'{"protocol": "rebar-9"}'}
        connection.execute(update(results).where(results.c.submission_id == UNKNOWN).values(**other))
    engine.dispose()
    with running_server(root, state, db=db) as server:
        for path in (f"submissions/{UNKNOWN}", "", "?config=lattice", f"api/v1/submissions/{UNKNOWN}"):
            assert httpx2.get(f"{server.url}/{path}", timeout=60).status_code == 200, path
        rows = httpx2.get(f"{server.url}/api/v1/leaderboard?config=lattice", timeout=60).json()["rows"]
        assert [row["id"] for row in rows] == [KEPT, LOST]
