"""Rankings: order and ranks, the table of a page, and the selection in its address."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

import pytest
from hypothesis import given
from hypothesis import strategies as st

from leaderboard.db.engine import Database
from leaderboard.db.models import LeaderboardRowModel, SubmissionModel, TokenModel
from leaderboard.db.rankings import LeaderboardEntry, Ranking, read_ranking
from leaderboard.web.pages.board_columns import COLUMNS_BY_NAME, METHOD
from leaderboard.web.pages.ranking import config_table
from leaderboard.web.pages.selection import Selection, parse_selection
from rebar_depth_bench.scoring.protocol import PROTOCOL
from tests.bench.reporting.results import result, scored_view, unpredicted_view
from tests.leaderboard.boards import DIGEST

ERRORS = [0.3, 0.1, 0.1, 2.0, 0.7, None, 0.05]
UNRANKED, HIDDEN = (5, 6), (1,)


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    """Yield a database of seven submissions of ``lattice``: two unranked, one not public."""
    opened = Database(f"sqlite:///{tmp_path / 'db.sqlite'}")
    opened.create_schema()
    with opened.write() as session:
        session.add(TokenModel(id=1, name="alice", sha256="0" * 64, created_at=0.0, baseline=False))
        session.flush()
        for index, error in enumerate(ERRORS):
            session.add(
                SubmissionModel(
                    id=f"s{index}",
                    token_id=1,
                    method=f"s{index}",
                    details="{}",
                    archive_sha256="0" * 64,
                    archive_bytes=1,
                    status="scored",
                    public=index not in HIDDEN,
                    created_at=100.0 + index,
                    queued_at=100.0 + index,
                    attempts=0,
                )
            )
            session.flush()
            session.add(
                LeaderboardRowModel(
                    submission_id=f"s{index}",
                    dataset_digest=DIGEST,
                    protocol=PROTOCOL,
                    config="lattice",
                    ranked=index not in UNRANKED,
                    rank_error=error,
                    json=json.dumps(table_of(error or 0.5)),
                )
            )
    yield opened
    opened.close()


def table_of(error: float) -> dict[str, Any]:
    """Return the JSON of a table of ``lattice``."""
    tables: dict[str, dict[str, Any]] = result(scored_view("lattice/0000", error)).to_dict()["tables"]
    return tables["lattice"]


def test_leaderboard_entries_are_public_and_in_order(database: Database) -> None:
    shown = [(row.rank, row.id) for row in read_ranking(database, "lattice", DIGEST).entries]
    assert shown == [(1, "s2"), (2, "s0"), (3, "s4"), (4, "s3"), (None, "s6"), (None, "s5")]


def test_best_rows_are_those_of_the_inputs_and_public(database: Database) -> None:
    """A better row that is not public, or that declares other inputs, takes no place."""
    with database.write() as session:
        for name, inputs in (("s1", "rgb"), ("s2", "stereo"), ("s0", "rgb"), ("s4", "rgb")):
            record = session.get_one(SubmissionModel, name)
            record.method, record.inputs = "m", inputs
        alice = session.get_one(TokenModel, 1)
    ranking = read_ranking(database, "lattice", DIGEST, alice)
    best = {name: [(row.id, row.rank) for row in ranking.best(name).entries] for name in ("rgb", None)}
    assert best["rgb"] == [("s1", None), ("s0", 1)]
    assert best[None][:3] == [("s1", None), ("s2", 1), ("s3", 2)]


def test_equal_errors_share_a_rank_overall_and_in_their_class(database: Database) -> None:
    with database.write() as session:
        for name, error, inputs in (("s0", 0.25, "rgb"), ("s2", 0.25, "stereo"), ("s3", 0.5, "rgb")):
            row = session.get_one(LeaderboardRowModel, (name, DIGEST, PROTOCOL, "lattice"))
            row.rank_error, row.ranked = error, True
            record = session.get_one(SubmissionModel, name)
            record.inputs, record.public = inputs, True
    ranking = read_ranking(database, "lattice", DIGEST)
    entries = ranking.by_id
    assert (entries["s0"].rank, entries["s2"].rank) == (1, 1)
    assert entries["s3"].rank == 3
    assert (entries["s0"].class_rank, entries["s2"].class_rank, entries["s3"].class_rank) == (1, 1, 2)
    assert {entry.class_rank for entry in ranking.entries if entry.inputs is None} == {None}
    shown = config_table(ranking, "lattice", Selection(inputs="rgb"), 50)["page"].rows
    assert [(entry.id, entry.rank) for entry in shown] == [("s0", 1), ("s3", 3)]


def test_pages_divide_the_rows(database: Database) -> None:
    ranking = read_ranking(database, "lattice", DIGEST)
    pages = [config_table(ranking, "lattice", Selection(page=page), 4)["page"] for page in (1, 2, 3)]
    assert [[entry.id for entry in page.rows] for page in pages] == [
        ["s2", "s0", "s4", "s3"],
        ["s6", "s5"],
        ["s6", "s5"],
    ]
    assert [page.selection.page for page in pages] == [1, 2, 2]
    assert {(page.row_count, page.pages) for page in pages} == {(6, 2)}


@pytest.mark.slow
@given(
    st.lists(st.one_of(st.none(), st.floats(0.01, 9.0)), max_size=12),
    st.sampled_from(sorted(COLUMNS_BY_NAME.keys() - {METHOD})),
)
def test_missing_values_are_sorted_last_in_both_orders(errors: list[float | None], name: str) -> None:
    views = [
        scored_view("lattice/0000", error, coverage=error / 9) if error else unpredicted_view("lattice/0000")
        for error in errors
    ]
    tables = [result(view).to_dict()["tables"]["lattice"] for view in views]
    entries = [
        entry_of(f"m{k}", table, {"seconds_per_view": error} if error else {})
        for k, (table, error) in enumerate(zip(tables, errors, strict=True))
    ]
    for selection in (Selection(name), Selection(name, inverted=True)):
        values = [COLUMNS_BY_NAME[name].value(entry) for entry in selection.sorted(entries)]
        present = [value for value in values if value is not None]
        assert values == present + [None] * (len(values) - len(present))
        assert present == sorted(present, reverse=selection.is_descending)


def entry_of(name: str, table: dict[str, Any], declared: dict[str, Any]) -> LeaderboardEntry:
    return LeaderboardEntry(
        id=name,
        config="lattice",
        method=name,
        submitter="alice",
        baseline=False,
        details=json.dumps(declared),
        inputs=None,
        uses_ground_truth=None,
        created_at=0.0,
        public=True,
        may_rank=True,
        rank_error=None,
        table_json=json.dumps(table),
    )


def test_rows_of_the_paper_and_references_have_the_columns_that_they_fill() -> None:
    ranking = Ranking((entry_of("m", table_of(0.5), {}),))
    table = config_table(ranking, "lattice", Selection(), 50)
    places = {column.number.place for column in COLUMNS_BY_NAME.values() if column.number}
    assert len(table["published"]) == 6
    for name, texts in (*table["published"], *table["references"]):
        assert name
        assert texts.keys() <= places, name
    assert config_table(Ranking(()), "lattice", Selection(), 50)["published"] == []


@given(
    st.sampled_from(sorted(COLUMNS_BY_NAME)),
    st.booleans(),
    st.sampled_from([None, "rgb", "rgb+K"]),
    st.text("ab &=?+%#äß", max_size=12),
    st.booleans(),
    st.integers(1, 99),
)
def test_query_of_a_selection_is_read_back(
    order: str, inverted: bool, inputs: str | None, text: str, all_rows: bool, page: int
) -> None:
    selection = Selection(order, inverted, inputs, text.strip(), all_rows, page)
    values = dict(parse_qsl(selection.query("lattice")))
    assert values.pop("config") == "lattice"
    assert parse_selection(values) == selection
