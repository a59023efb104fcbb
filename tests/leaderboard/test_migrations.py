"""The database's schema: what the migrations make is what the records say, on SQLite and on PostgreSQL."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Column, Engine, MetaData, String, create_engine, inspect

from leaderboard.db.engine import MIGRATIONS, Database
from leaderboard.db.models import Base
from leaderboard.db.tokens import create_token, find_token
from leaderboard.settings import Settings

_MIGRATE = """
import sys
from leaderboard.database import Database
database = Database(sys.argv[1])
print("ready", flush=True)
sys.stdin.readline()
database.migrate()
"""


@pytest.fixture
def url(new_database: Callable[[], str], tmp_path: Path) -> str:
    """An empty database as SQLAlchemy takes it."""
    return Settings(data="x", state=tmp_path, db=new_database()).database_url  # type: ignore[call-arg]


@pytest.fixture
def engine(url: str) -> Iterator[Engine]:
    """An engine of the test's own, beside the database's."""
    made = create_engine(url)
    yield made
    made.dispose()


def migrate(url: str) -> None:
    with closing(Database(url)) as database:
        database.migrate()


def differences(engine: Engine, metadata: MetaData) -> list[object]:
    """What Alembic would change to make the database what ``metadata`` says, types and defaults too."""
    with engine.connect() as connection:
        options = {"compare_type": True, "compare_server_default": True}
        return list(compare_metadata(MigrationContext.configure(connection, opts=options), metadata))


def test_the_migrated_schema_is_the_records(url: str, engine: Engine) -> None:
    assert len(differences(engine, Base.metadata)) >= len(Base.metadata.tables), "an empty database lacks them all"
    migrate(url)
    assert differences(engine, Base.metadata) == []
    assert set(inspect(engine).get_table_names()) == {*Base.metadata.tables, "alembic_version"}


def test_the_comparison_sees_a_column_that_no_migration_makes(url: str, engine: Engine) -> None:
    migrate(url)
    changed = MetaData()
    for table in Base.metadata.tables.values():
        table.to_metadata(changed)
    changed.tables["tokens"].append_column(Column("forgotten", String(10)))
    assert [step[0] for step in differences(engine, changed)] == ["add_column"]  # type: ignore[index]


def test_migrating_again_changes_nothing_and_keeps_what_is_there(url: str) -> None:
    with closing(Database(url)) as database:
        database.migrate()
        token = create_token(database, "alice")
        database.migrate()
    with closing(Database(url)) as database:
        database.migrate()
        found = find_token(database, token)
    assert found is not None
    assert found.name == "alice"


@contextmanager
def busy(engine: Engine) -> Iterator[None]:
    """Hold SQLite's write lock, so that all who migrate meanwhile began before the first of them may write."""
    if engine.dialect.name != "sqlite":
        yield
        return
    with closing(sqlite3.connect(str(engine.url.database), isolation_level=None)) as connection:
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute("BEGIN IMMEDIATE")
        yield
        time.sleep(1)
        connection.execute("ROLLBACK")


def test_processes_that_migrate_at_once_all_succeed(url: str, engine: Engine) -> None:
    command, pipe = [sys.executable, "-c", _MIGRATE, url], subprocess.PIPE
    started = [subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True) for _ in range(3)]
    try:
        for process in started:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
        with busy(engine):
            for process in started:
                assert process.stdin is not None
                process.stdin.write("\n")
                process.stdin.flush()
        for process in started:
            _, complaints = process.communicate(timeout=60)
            assert process.returncode == 0, complaints
    finally:
        for process in started:
            process.kill()
            process.communicate()
    assert differences(engine, Base.metadata) == []


def test_there_is_one_line_of_migrations() -> None:
    scripts = ScriptDirectory(str(MIGRATIONS))
    assert len(scripts.get_heads()) == 1
    assert len(scripts.get_bases()) == 1
