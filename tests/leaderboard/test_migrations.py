"""Database schema: agreement of migrations and models on SQLite and PostgreSQL."""

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
from rebar_depth_bench.base.errors import InputError

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


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ("UPDATE alembic_version SET version_num = '0003'", "the schema of revision 0003"),
        ("DELETE FROM alembic_version", "a schema without a revision"),
        ("DROP TABLE alembic_version", "a schema without a revision"),
    ],
)
def test_database_of_another_revision_is_refused(url: str, engine: Engine, change: str, found: str) -> None:
    migrate(url)
    with engine.begin() as connection:
        connection.exec_driver_sql(change)
    with closing(Database(url)) as database:
        for use in (database.migrate, database.check_schema):
            with pytest.raises(InputError, match=f"the database has {found}, expected 0004, or a new database"):
                use()
    with engine.connect() as connection:
        tables = inspect(connection).get_table_names()
    assert set(Base.metadata.tables) <= set(tables)


def test_tables_of_other_programs_are_left_alone(url: str, engine: Engine) -> None:
    with engine.begin() as connection:
        connection.exec_driver_sql("CREATE TABLE foreign_table (id INTEGER)")
    migrate(url)
    assert set(inspect(engine).get_table_names()) == {*Base.metadata.tables, "alembic_version", "foreign_table"}


def test_migrations_have_one_base() -> None:
    scripts = ScriptDirectory(str(MIGRATIONS))
    assert (scripts.get_heads(), scripts.get_bases()) == (["0004"], ["0004"])
