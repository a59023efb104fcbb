"""SQLite or PostgreSQL: transactions that read, transactions that write, and the schema brought up to date."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from alembic import command
from alembic.config import Config
from sqlalchemy import Connection, Engine, create_engine, event
from sqlalchemy.exc import ArgumentError, DatabaseError, InterfaceError, NoSuchModuleError, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from sqlalchemy.orm import Session

from leaderboard.redact import without_password
from rebar_depth_bench.errors import InputError

MIGRATIONS = Path(__file__).parent / "migrations"
BUSY_S = 30
AWAY = (OperationalError, InterfaceError, PoolTimeoutError)
"""What is raised while the database does not answer: it is down, is starting, or has no connection left."""
_PATIENCE = {"connect_timeout": 10, "tcp_user_timeout": 30_000}
"""How long a PostgreSQL that is silent is waited for: seconds, milliseconds."""
_IMMEDIATE = "immediate"


class Database:
    """A pool of connections. On SQLite writers take the one write lock first and wait for it, readers never do."""

    def __init__(self, url: str) -> None:
        """Raise ``InputError`` for a URL that names no database."""
        try:
            self._engine = _engine(url)
        except (ArgumentError, NoSuchModuleError, ImportError, OSError) as error:
            raise InputError(f"{without_password(url)}: no database's URL: {error}") from None
        self._writer = self._engine.execution_options(**{_IMMEDIATE: True})

    @contextmanager
    def read(self) -> Iterator[Session]:
        """Yield a session for reading."""
        with Session(self._engine, expire_on_commit=False) as session:
            yield session

    @contextmanager
    def write(self) -> Iterator[Session]:
        """Yield a session whose changes are durable when the block ends, or all undone if it raises."""
        with Session(self._writer, expire_on_commit=False) as session, session.begin():
            yield session

    @property
    def waits_for_rows(self) -> bool:
        """Whether rows are locked one by one (PostgreSQL), not the whole database (SQLite)."""
        return self._engine.dialect.name != "sqlite"

    def migrate(self) -> None:
        """Bring the schema up to date; two services that start at once do it one after the other.

        Raises ``InputError`` where the database does not answer.
        """
        config = Config()
        config.set_main_option("script_location", str(MIGRATIONS))
        try:
            with self._writer.begin() as connection:
                if self.waits_for_rows:
                    connection.exec_driver_sql("SELECT pg_advisory_xact_lock(7241053)")
                config.attributes["connection"] = connection
                command.upgrade(config, "head")
        except (*AWAY, DatabaseError) as error:
            url = self._engine.url.render_as_string(hide_password=True)
            reason = " ".join(str(getattr(error, "orig", error)).split())
            raise InputError(f"{url}: the database does not answer: {reason}") from None

    def close(self) -> None:
        """Give back all connections."""
        self._engine.dispose()


def _engine(url: str) -> Engine:
    if not url.startswith("sqlite"):
        return create_engine(
            url, hide_parameters=True, connect_args=_PATIENCE, pool_pre_ping=True, pool_size=10, max_overflow=10
        )
    Path(url.removeprefix("sqlite:///")).parent.mkdir(parents=True, exist_ok=True)
    engine = create_engine(
        url, hide_parameters=True, connect_args={"timeout": BUSY_S}, pool_size=20, max_overflow=20
    )
    event.listen(engine, "connect", _durable)
    event.listen(engine, "begin", _begin)
    return engine


def _durable(connection: Any, _: Any) -> None:
    """Readers beside a writer, and a commit that a power cut does not undo; SQLAlchemy begins transactions."""
    connection.isolation_level = None
    cursor = connection.cursor()
    for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON"):
        cursor.execute(f"PRAGMA {pragma}")
    cursor.close()


def _begin(connection: Connection) -> None:
    immediate = connection.get_execution_options().get(_IMMEDIATE, False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if immediate else "BEGIN")
