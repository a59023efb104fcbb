"""Database schema: agreement of migrations and models on SQLite and PostgreSQL."""

from __future__ import annotations

import json
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Column, Engine, MetaData, String, create_engine, insert, inspect

from leaderboard.db.engine import MIGRATIONS, Database
from leaderboard.db.models import Base, LeaderboardRowModel
from leaderboard.db.rankings import picture_facts, picture_webp, read_ranking
from leaderboard.db.tokens import create_token, digest, find_token
from leaderboard.db.versions import VersionReader
from leaderboard.db.view_errors import unpack_view_errors
from leaderboard.settings import Settings
from rebar_depth_bench.errors import InputError
from tests.bench.reporting.results import result, scored_view
from tests.leaderboard.old_schema import create_old_schema

_MIGRATE = """
import sys
from leaderboard.db.engine import Database
database = Database(sys.argv[1])
print("ready", flush=True)
sys.stdin.readline()
database.migrate()
"""


@pytest.fixture
def url(new_database: Callable[[], str], tmp_path: Path) -> str:
    """Return the SQLAlchemy URL of an empty database."""
    return Settings(data="x", state_dir=tmp_path, db=new_database()).database_url  # type: ignore[call-arg]


@pytest.fixture
def engine(url: str) -> Iterator[Engine]:
    """Yield a separate engine for the database."""
    new_engine = create_engine(url)
    yield new_engine
    new_engine.dispose()


def migrate(url: str) -> None:
    with closing(Database(url)) as database:
        database.migrate()


def differences(engine: Engine, metadata: MetaData) -> list[object]:
    """Return the changes, including types and defaults, that Alembic would need to match ``metadata``."""
    with engine.connect() as connection:
        options = {"compare_type": True, "compare_server_default": True}
        return list(compare_metadata(MigrationContext.configure(connection, opts=options), metadata))


def test_migrated_schema_matches_models(url: str, engine: Engine) -> None:
    assert len(differences(engine, Base.metadata)) >= len(Base.metadata.tables), "an empty database lacks them all"
    migrate(url)
    assert differences(engine, Base.metadata) == []
    assert set(inspect(engine).get_table_names()) == {*Base.metadata.tables, "alembic_version"}


def test_schema_comparison_detects_missing_migration(url: str, engine: Engine) -> None:
    migrate(url)
    changed = MetaData()
    for table in Base.metadata.tables.values():
        table.to_metadata(changed)
    changed.tables["tokens"].append_column(Column("forgotten", String(10)))
    assert [step[0] for step in differences(engine, changed)] == ["add_column"]  # type: ignore[index]


def test_repeated_migration_keeps_rows(url: str) -> None:
    with closing(Database(url)) as database:
        database.migrate()
        token = create_token(database, "alice")
        database.migrate()
    with closing(Database(url)) as database:
        database.migrate()
        record = find_token(database, token)
    assert record is not None
    assert record.name == "alice"


@contextmanager
def sqlite_write_lock(engine: Engine) -> Iterator[None]:
    """Hold SQLite's write lock so that all concurrent migrations start before any of them can write."""
    if engine.dialect.name != "sqlite":
        yield
        return
    with closing(sqlite3.connect(str(engine.url.database), isolation_level=None)) as connection:
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute("BEGIN IMMEDIATE")
        yield
        time.sleep(1)
        connection.execute("ROLLBACK")


@pytest.mark.slow
def test_concurrent_migrations_succeed(url: str, engine: Engine) -> None:
    arguments, pipe = [sys.executable, "-c", _MIGRATE, url], subprocess.PIPE
    processes = [subprocess.Popen(arguments, stdin=pipe, stdout=pipe, stderr=pipe, text=True) for _ in range(3)]
    try:
        for process in processes:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
        with sqlite_write_lock(engine):
            for process in processes:
                assert process.stdin is not None
                process.stdin.write("\n")
                process.stdin.flush()
        for process in processes:
            _, stderr = process.communicate(timeout=60)
            assert process.returncode == 0, stderr
    finally:
        for process in processes:
            process.kill()
            process.communicate()
    assert differences(engine, Base.metadata) == []


def test_database_of_revision_2_keeps_error_maps_and_gets_view_errors(url: str, engine: Engine) -> None:
    document = result(*(scored_view(f"lattice/{index:04d}") for index in range(3))).to_dict()
    with engine.begin() as connection:
        create_old_schema(connection, "0002")
        tables = MetaData()
        tables.reflect(connection)
        rows: dict[str, dict[str, Any]] = {
            "tokens": {"id": 1, "name": "alice", "sha256": digest("a token"), "created_at": 1.0},
            "submissions": {**SUBMISSION, "id": "one", "token_id": 1},
            "results": {"submission_id": "one", "json": json.dumps(document).encode(), "protocol": "rebar-2"},
            "board_rows": {
                "submission_id": "one",
                "config": "lattice",
                "ranked": True,
                "rank_error": 0.5,
                "json": json.dumps(document["tables"]["lattice"]),
            },
            "pictures": {"submission_id": "one", "view_id": "lattice/0000", "webp": b"webp"},
        }
        for name, row in rows.items():
            connection.execute(insert(tables.tables[name]), row)
    migrate(url)
    assert differences(engine, Base.metadata) == []
    with closing(Database(url)) as database:
        assert picture_webp(database, "one", "lattice/0000", "error") == b"webp"
        assert picture_facts(database, "one") == {"lattice/0000": ({}, ["error"])}
        [entry] = read_ranking(database, "lattice", "sha256:0").entries
        assert (entry.id, entry.submitter, entry.rank) == ("one", "alice", 1)
        assert find_token(database, "a token") is not None
        with database.read() as session:
            packed = session.get_one(LeaderboardRowModel, ("one", "lattice")).view_errors
    assert packed is not None
    assert unpack_view_errors(packed)[1].tolist() == [view["rank_error"] for view in document["views"]]


SUBMISSION = {
    "method": "m",
    "archive_sha256": "0" * 64,
    "archive_bytes": 1,
    "status": "scored",
    "public": True,
    "created_at": 1.0,
    "finished_at": 2.0,
    "attempts": 1,
    "dataset_digest": "sha256:0",
}


def test_database_of_revision_1_migrates(url: str, engine: Engine) -> None:
    with engine.begin() as connection:
        create_old_schema(connection, "0001")
    migrate(url)
    assert differences(engine, Base.metadata) == []
    with closing(Database(url)) as database, closing(VersionReader(database)) as versions:
        assert versions.read() == 1


def test_database_of_another_version_is_refused_in_words(url: str, engine: Engine) -> None:
    with closing(Database(url)) as database:
        database.migrate()
        database.check_schema()
        with engine.begin() as connection:
            connection.exec_driver_sql("UPDATE alembic_version SET version_num = '0999'")
        for use in (database.migrate, database.check_schema):
            with pytest.raises(InputError, match="has the schema 0999 of another version, expected 0"):
                use()


def test_migrations_are_linear() -> None:
    scripts = ScriptDirectory(str(MIGRATIONS))
    assert len(scripts.get_heads()) == 1
    assert len(scripts.get_bases()) == 1
