"""Database engine for SQLite and PostgreSQL: read sessions, write sessions, the schema and checks."""

from __future__ import annotations

import json
import re
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sqlalchemy import URL, Connection, Engine, create_engine, event, inspect, select, text
from sqlalchemy.exc import ArgumentError, DatabaseError, InterfaceError, NoSuchModuleError, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from sqlalchemy.orm import Session

from leaderboard.db.models import SCHEMA, Base, BoardModel, ResultModel
from rebar_depth_bench.base.errors import InputError, StorageError

SQLITE_BUSY_TIMEOUT_S = 30
DATABASE_UNAVAILABLE = (OperationalError, InterfaceError, PoolTimeoutError)
"""Exceptions raised while the database is unavailable: down, starting, or no connection left in the pool."""
_POSTGRESQL_TIMEOUTS = {"connect_timeout": 10, "tcp_user_timeout": 30_000}
"""Timeouts for an unresponsive PostgreSQL server: connect in seconds, unacknowledged TCP data in ms."""
_IMMEDIATE = "immediate"
_CONTENT_VERSION = select(BoardModel.content_version)
_OWN_TABLES = frozenset(Base.metadata.tables)


class Database:
    """Connection pool of the database.

    On SQLite, write transactions acquire the single write lock at their start (``BEGIN IMMEDIATE``) and wait for
    it; read transactions never wait.

    With ``read_only``, an SQLite database must exist, and nothing is written or created to read it.
    """

    def __init__(self, url: str, *, read_only: bool = False) -> None:
        """Create the engine. Raises ``InputError`` if ``url`` is not a valid database URL."""
        self._url = url
        try:
            self._engine = _engine(url, read_only)
        except (ArgumentError, NoSuchModuleError, ImportError, OSError) as error:
            raise InputError(f"{without_password(url)}: invalid database URL: {error}") from None
        self.file = sqlite_path(url)
        """The file of an SQLite database, None for another database."""
        self._write_engine = self._engine.execution_options(**{_IMMEDIATE: True})

    @contextmanager
    def read(self) -> Iterator[Session]:
        """Yield a read session; its objects stay usable after it is closed."""
        with Session(self._engine, expire_on_commit=False) as session:
            yield session

    @contextmanager
    def write(self) -> Iterator[Session]:
        """Yield a session that is committed durably when the block ends, or rolled back if it raises."""
        with Session(self._write_engine, expire_on_commit=False) as session, session.begin():
            yield session

    def content_version(self) -> int:
        """Return the version of everything that pages show, apart from queue positions."""
        with self._engine.connect() as connection:
            return int(connection.scalar(_CONTENT_VERSION) or 0)

    def board(self) -> BoardModel:
        """Return the facts on the whole leaderboard."""
        with self.read() as session:
            return session.scalars(select(BoardModel)).one()

    @property
    def has_row_locks(self) -> bool:
        """Whether single rows can be locked (PostgreSQL) instead of the whole database only (SQLite)."""
        return self._engine.dialect.name != "sqlite"

    def create_schema(self) -> None:
        """Create the tables in an empty database; services that start simultaneously take turns.

        Raises ``InputError`` if the database is unavailable, or has the tables of another version.
        """
        with database_errors(self._url, InputError), self._write_engine.begin() as connection:
            if self.has_row_locks:
                connection.exec_driver_sql("SELECT pg_advisory_xact_lock(7241053)")
            if _OWN_TABLES.isdisjoint(inspect(connection).get_table_names()):
                Base.metadata.create_all(connection, checkfirst=False)
            _check_schema(connection)

    def check_schema(self) -> None:
        """Raise ``InputError`` unless the database has the schema of this version."""
        with self._engine.connect() as connection:
            _check_schema(connection)

    def problems(self) -> list[str]:
        """Return what is damaged: pages and references of an SQLite database, and results."""
        found: list[str] = []
        try:
            with self.read() as session:
                for pragma in () if self.has_row_locks else ("integrity_check(5)", "foreign_key_check"):
                    rows = session.execute(text(f"PRAGMA {pragma}"))
                    found += [f"the database is damaged: {pragma} finds {row}" for row in rows if row != ("ok",)]
                results = select(ResultModel.submission_id, ResultModel.json).where(ResultModel.json.is_not(None))
                for submission_id, content in session.execute(results, execution_options={"yield_per": 20}):
                    if problem := _result_problem(content or b""):
                        found.append(f"the result of submission {submission_id} is {problem}")
        except DatabaseError as error:
            found.append(f"the database is damaged: {error.orig}")
        return found

    def close(self) -> None:
        """Close all connections."""
        self._engine.dispose()


def _result_problem(content: bytes) -> str | None:
    """Return what a stored result is if it is none, or None."""
    try:
        result = json.loads(content)
    except ValueError:
        return "no JSON"
    match result:
        case {"protocol": str(), "dataset": {"digest": str()}, "tables": dict()}:
            return None
    return "no result of scoring"


def without_password(url: str) -> str:
    """Return a database URL for messages, with the user name and password before its host replaced by ``...``."""
    return re.sub(r"://.*@", "://...@", url)


def sqlite_path(url: str) -> Path | None:
    """Return the file of an SQLite database, or None for another database."""
    prefix = "sqlite:///"
    return Path(url.removeprefix(prefix)) if url.startswith(prefix) else None


@contextmanager
def database_errors(url: str, kind: type[InputError | StorageError] = StorageError) -> Iterator[None]:
    """Raise the errors of a database that is unavailable or damaged as errors of a ``kind`` that name it."""
    try:
        yield
    except (*DATABASE_UNAVAILABLE, DatabaseError) as error:
        reason = " ".join(str(getattr(error, "orig", error)).split())
        raise kind(f"{without_password(url)}: the database is unavailable: {reason}") from None


def _engine(url: str, read_only: bool) -> Engine:
    path = sqlite_path(url)
    if path is None:
        return create_engine(
            url,
            hide_parameters=True,
            connect_args=_POSTGRESQL_TIMEOUTS,
            pool_pre_ping=True,
            pool_size=10,
            max_overflow=10,
        )
    sqlite_url = URL.create("sqlite", database=str(path))  # As text, SQLAlchemy would replace %20 in the path.
    if read_only:
        # Without a write-ahead log nobody has the database open, and SQLite would create one to read it.
        mode = "mode=ro" if Path(f"{path}-wal").exists() else "immutable=1"
        uri = f"{path.resolve().as_uri()}?{mode}"
        return create_engine(sqlite_url, creator=lambda: sqlite3.connect(uri, uri=True))
    path.parent.mkdir(parents=True, exist_ok=True)
    engine = create_engine(
        sqlite_url,
        hide_parameters=True,
        connect_args={"timeout": SQLITE_BUSY_TIMEOUT_S},
        pool_size=20,
        max_overflow=20,
    )
    event.listen(engine, "connect", _configure_sqlite)
    event.listen(engine, "begin", _begin_transaction)
    return engine


def _configure_sqlite(connection: Any, _: Any) -> None:
    """Set the SQLite pragmas for concurrent readers (WAL) and for commits that survive a power failure.

    The driver's own transaction control is disabled; ``_begin_transaction`` issues BEGIN.
    """
    connection.isolation_level = None
    cursor = connection.cursor()
    for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON"):
        cursor.execute(f"PRAGMA {pragma}")
    cursor.close()


def _begin_transaction(connection: Connection) -> None:
    immediate = connection.get_execution_options().get(_IMMEDIATE, False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if immediate else "BEGIN")


def _check_schema(connection: Connection) -> None:
    is_known = inspect(connection).has_table(BoardModel.__tablename__)
    found = connection.scalar(select(BoardModel.schema)) if is_known else None
    if found != SCHEMA:
        url = connection.engine.url.render_as_string(hide_password=True)
        has = "no schema of this service" if found is None else f"schema {found}"
        raise InputError(f"{url}: the database has {has}, expected schema {SCHEMA}, or a new database")
