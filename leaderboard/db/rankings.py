"""Ranking queries: the rows of a config with their ranks, and the queue position.

The queries select columns instead of ORM objects, so that a page with hundreds of rows takes milliseconds.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

from sqlalchemy import false, func, select

from leaderboard.db.engine import Database
from leaderboard.db.models import LeaderboardRowModel, SubmissionModel, TokenModel
from leaderboard.db.submissions import QUEUED
from rebar_depth_bench.scoring.protocol import PROTOCOL
from rebar_depth_bench.submission.declaration import INPUTS

_CACHED_OBJECTS = 4096
MISSING_ERROR = 1.0
"""Rank error that counts where a submission lacks a config: that of no prediction at all."""
_SIGNIFICANT_DIGITS = 12


@dataclass(frozen=True)
class LeaderboardEntry:
    """A submission's row of one config; ``rank`` is None if the row is not ranked.

    ``class_rank`` is the rank among the submissions that declare the same ``inputs``, None without a declaration.
    ``baseline`` marks the organiser's rows. ``details`` is the column of ``SubmissionModel``, and ``table_json``
    the JSON text of the config's table in the result.
    """

    id: str
    config: str
    method: str
    submitter: str
    baseline: bool
    details: str
    inputs: str | None
    uses_ground_truth: bool | None
    created_at: float
    public: bool
    may_rank: bool
    rank_error: float | None
    table_json: str
    rank: int | None = None
    class_rank: int | None = None

    @property
    def declared(self) -> dict[str, Any]:
        """What the submitter says about the method, by name; what is not given is absent."""
        return _parsed(self.details)

    @property
    def url(self) -> str | None:
        """Page or paper of the method."""
        url: str | None = self.declared.get("url")
        return url

    @property
    def table(self) -> dict[str, Any]:
        """The table's JSON object, which must not be changed."""
        return _parsed(self.table_json)


@lru_cache(maxsize=_CACHED_OBJECTS)
def _parsed(text: str) -> dict[str, Any]:
    """Return a JSON object; cached, because most rows stay the same when the content changes."""
    found: dict[str, Any] = json.loads(text)
    return found


_COLUMNS = (
    SubmissionModel.id,
    LeaderboardRowModel.config,
    SubmissionModel.method,
    TokenModel.name,
    TokenModel.baseline,
    SubmissionModel.details,
    SubmissionModel.inputs,
    SubmissionModel.uses_ground_truth,
    SubmissionModel.created_at,
    SubmissionModel.public,
    LeaderboardRowModel.ranked,
    LeaderboardRowModel.rank_error,
    LeaderboardRowModel.json,
)
"""Columns of the fields of an entry, without ranks."""


@dataclass(frozen=True)
class Ranking:
    """Rows of a config: ranked rows first, by rank error, then unranked ones; ties by age, oldest first."""

    entries: tuple[LeaderboardEntry, ...]

    def best(self, inputs: str | None = None) -> Ranking:
        """Return the best row of each submitter and method name of those that declare ``inputs`` (None: of all).

        Ranks are those among these rows. Rows that are not public are all returned.
        """
        best: dict[tuple[str, ...], LeaderboardEntry] = {}
        for entry in self.of_class(inputs):
            best.setdefault((entry.submitter, entry.method) if entry.public else (entry.id,), entry)
        return Ranking(_with_ranks(list(best.values())))

    @cached_property
    def by_id(self) -> dict[str, LeaderboardEntry]:
        """Rows by submission id."""
        return {entry.id: entry for entry in self.entries}

    def of_class(self, inputs: str | None) -> list[LeaderboardEntry]:
        """Return the rows that declare ``inputs``, all rows for None; their ranks are kept."""
        return [entry for entry in self.entries if inputs is None or entry.inputs == inputs]


def read_ranking(
    database: Database, config: str, dataset_digest: str, viewer: TokenModel | None = None
) -> Ranking:
    """Return the public rows of a config and those of ``viewer``.

    Results of other datasets than the one with ``dataset_digest``, and of other protocols, are left out. Equal
    rank errors share a rank. A row that is not public has no rank and does not affect the ranks of others.
    """
    own = false() if viewer is None else SubmissionModel.token_id == viewer.id
    query = (
        select(*_COLUMNS)
        .join(SubmissionModel, SubmissionModel.id == LeaderboardRowModel.submission_id)
        .join(TokenModel, TokenModel.id == SubmissionModel.token_id)
        .where(
            LeaderboardRowModel.config == config,
            LeaderboardRowModel.dataset_digest == dataset_digest,
            LeaderboardRowModel.protocol == PROTOCOL,
            SubmissionModel.public | own,
        )
        .order_by(SubmissionModel.created_at)
    )
    with database.read() as session:
        entries = [LeaderboardEntry(*tuple(row)) for row in session.execute(query)]
    # Sorted here, because databases round differently; the sort is stable.
    entries.sort(key=lambda entry: (not entry.may_rank, entry.rank_error is None, entry.rank_error))
    return Ranking(_with_ranks(entries))


def _with_ranks(entries: Sequence[LeaderboardEntry]) -> tuple[LeaderboardEntry, ...]:
    """Return sorted entries with their ranks."""
    ranked = [entry for entry in entries if entry.may_rank and entry.public]
    ranks = _ranks((entry.id, entry.rank_error) for entry in ranked)
    class_ranks: dict[str, int] = {}
    for name in INPUTS:
        class_ranks |= _ranks((entry.id, entry.rank_error) for entry in ranked if entry.inputs == name)
    return tuple(
        replace(entry, rank=ranks.get(entry.id), class_rank=class_ranks.get(entry.id)) for entry in entries
    )


def _ranks(errors: Iterable[tuple[str, float | None]]) -> dict[str, int]:
    """Return the ranks by submission id of ids and errors in ascending order; equal errors share a rank."""
    first: dict[float | None, int] = {}
    return {
        submission_id: first.setdefault(error, place)
        for place, (submission_id, error) in enumerate(errors, start=1)
    }


@dataclass(frozen=True)
class OverallEntry:
    """A submission, its mean rank error over all configs, and its entries by config; ``rank`` None: not ranked."""

    mean: float
    entries: dict[str, LeaderboardEntry]
    rank: int | None = None

    @property
    def first(self) -> LeaderboardEntry:
        """An entry of the submission."""
        return next(iter(self.entries.values()))

    @property
    def is_ranked(self) -> bool:
        """Whether the submission is ranked in any config."""
        return any(entry.rank is not None for entry in self.entries.values())


def overall_ranking(rankings: Sequence[tuple[str, Ranking]], *, best: bool = False) -> list[OverallEntry]:
    """Return the submissions in order of their mean rank error over the configs of ``rankings``.

    A config that a submission lacks counts ``MISSING_ERROR``; results of different submissions are not combined.
    Submissions that are ranked in no config come last. With ``best``, only the best submission of each submitter
    and method name is returned.
    """
    by_id: dict[str, dict[str, LeaderboardEntry]] = {}
    for config, ranking in rankings:
        for entry in ranking.entries:
            by_id.setdefault(entry.id, {})[config] = entry
    all_entries = [OverallEntry(_mean_error(entries, len(rankings)), entries) for entries in by_id.values()]
    all_entries.sort(key=lambda one: (not one.is_ranked, one.mean, one.first.created_at))
    if best:
        first: dict[tuple[str, str], OverallEntry] = {}
        for one in all_entries:
            first.setdefault((one.first.submitter, one.first.method), one)
        all_entries = list(first.values())
    ranks = _ranks((one.first.id, one.mean) for one in all_entries if one.is_ranked)
    return [replace(one, rank=ranks.get(one.first.id)) for one in all_entries]


def _mean_error(entries: Mapping[str, LeaderboardEntry], configs: int) -> float:
    errors = [MISSING_ERROR if entry.rank_error is None else entry.rank_error for entry in entries.values()]
    mean = (sum(errors) + MISSING_ERROR * (configs - len(entries))) / configs
    return float(f"{mean:.{_SIGNIFICANT_DIGITS}g}")


class CurrentRankings:
    """Rankings of a dataset's public rows, each read from the database once per content version; thread-safe."""

    def __init__(self, database: Database, dataset_digest: str) -> None:
        self._database, self._dataset_digest = database, dataset_digest
        self._lock = threading.Lock()
        self._version, self._by_config = -1, dict[str, Ranking]()

    def of(self, config: str, viewer: TokenModel | None = None) -> Ranking:
        """Return the current ranking of a config, with the rows of ``viewer``."""
        if viewer is not None:
            return read_ranking(self._database, config, self._dataset_digest, viewer)
        with self._lock:
            version = self._database.content_version()
            if version != self._version:
                self._version, self._by_config = version, {}
            if config not in self._by_config:
                self._by_config[config] = read_ranking(self._database, config, self._dataset_digest)
            return self._by_config[config]


def queue_position(database: Database, submission: SubmissionModel) -> tuple[int, int] | None:
    """Return the position of a submission in the queue, where 1 is next, and the number of waiting submissions.

    Return None if the submission is not queued.
    """
    if submission.status != QUEUED:
        return None
    older = func.count().filter(SubmissionModel.created_at < submission.created_at)
    query = select(older, func.count()).where(SubmissionModel.status == QUEUED)
    with database.read() as session:
        before, waiting = session.execute(query).one()
    return before + 1, max(waiting, before + 1)
