"""Counter of content changes in the database, by which cached responses and rankings are recognised as current."""

from __future__ import annotations

import sqlite3
import threading
from contextlib import suppress

from sqlalchemy import select

from leaderboard.db.engine import Database
from leaderboard.db.models import ContentVersionModel, TokenModel
from leaderboard.db.rankings import Ranking, read_ranking


class VersionReader:
    """Reader of the version of everything that pages show, apart from queue positions."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._sqlite = None if database.file is None else sqlite3.connect(database.file, check_same_thread=False)
        self._last: tuple[int, int] | None = None

    def close(self) -> None:
        """Close the connection."""
        if self._sqlite is not None:
            self._sqlite.close()

    def read(self) -> int:
        """Return the version, with a query."""
        data_version = self._data_version()
        with self._database.read() as session:
            version = session.scalar(select(ContentVersionModel.value)) or 0
        self._last = None if data_version is None else (data_version, version)
        return version

    def unchanged(self) -> int | None:
        """Return the version that was read last if no commit can have changed it, otherwise None.

        This takes microseconds and does not wait: SQLite counts the commits of other connections in
        ``PRAGMA data_version``. For other databases the result is None.
        """
        last = self._last
        return last[1] if last is not None and last[0] == self._data_version() else None

    def _data_version(self) -> int | None:
        if self._sqlite is not None:
            with suppress(sqlite3.Error):
                return int(self._sqlite.execute("PRAGMA data_version").fetchone()[0])
        return None


class CurrentRankings:
    """Rankings of a dataset's public rows, each read from the database once per content version; thread-safe."""

    def __init__(self, database: Database, versions: VersionReader, dataset_digest: str) -> None:
        self._database, self._versions, self._dataset_digest = database, versions, dataset_digest
        self._lock = threading.Lock()
        self._version, self._by_config = -1, dict[str, Ranking]()

    def of(self, config: str, viewer: TokenModel | None = None) -> Ranking:
        """Return the current ranking of a config, with the rows of ``viewer``."""
        if viewer is not None:
            return read_ranking(self._database, config, self._dataset_digest, viewer)
        with self._lock:
            version = self._versions.unchanged()
            version = self._versions.read() if version is None else version
            if version != self._version:
                self._version, self._by_config = version, {}
            if config not in self._by_config:
                self._by_config[config] = read_ranking(self._database, config, self._dataset_digest)
            return self._by_config[config]
