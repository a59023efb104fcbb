"""What the pages are made of: orders, ranks, the form's first field, texts of strangers."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from leaderboard.db.engine import Database
from leaderboard.db.models import ResultRecord, RowRecord, SubmissionRecord, TokenRecord
from leaderboard.db.rankings import board, queue_place, ranks, standings
from leaderboard.uploads.multipart import MOST_FIELD, UploadError, leading_field
from leaderboard.web.pages.leaderboard import COLUMNS, MOST_PLOTTED, RANK, Order, make_board, ordered, read_order
from leaderboard.web.pages.rendering import lines, link, moment, size
from rebar_depth_bench.reporting.html.rows import table_row
from rebar_depth_bench.scoring.result import tabulate
from rebar_depth_bench.scoring.result_io import read_result
from tests.bench.reporting.results import overflowed, result, scored, unpredicted

ERRORS = [0.3, 0.1, 0.1, 2.0, 0.7, None, 0.05]
UNRANKED, HIDDEN = (5, 6), (1,)


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    """Seven submissions of ``lattice``: two that are not ranked, one that is not public."""
    opened = Database(f"sqlite:///{tmp_path / 'db.sqlite'}")
    opened.migrate()
    with opened.write() as session:
        session.add(TokenRecord(id=1, name="alice", sha256="0" * 64, created_at=0.0))
        session.flush()
        for place, error in enumerate(ERRORS):
            found = result(scored("lattice/0000", error or 0.5), method=f"m{place}").to_dict()
            table = {**found["tables"]["lattice"], "ranked": place not in UNRANKED}
            session.add(submission(f"s{place}", 100.0 + place, public=place not in HIDDEN))
            session.flush()
            session.add(ResultRecord(submission_id=f"s{place}", json=json.dumps(found).encode()))
            session.add(
                RowRecord(
                    submission_id=f"s{place}",
                    config="lattice",
                    ranked=table["ranked"],
                    abs_rel=error,
                    json=json.dumps(table),
                )
            )
    yield opened
    opened.close()


def submission(name: str, created_at: float, *, public: bool = True, status: str = "scored") -> SubmissionRecord:
    return SubmissionRecord(
        id=name,
        token_id=1,
        method=name,
        archive_sha256="0" * 64,
        archive_bytes=1,
        status=status,
        public=public,
        created_at=created_at,
        attempts=0,
        dataset_digest="sha256:0",
    )


def test_standings_are_the_board(database: Database) -> None:
    shown = [(one.rank, one.submission_id) for one in standings(database, "lattice")]
    assert shown == [(1, "s2"), (2, "s0"), (3, "s4"), (4, "s3"), (None, "s6"), (None, "s5")]
    assert dict(shown[:4]) == {row.rank: row.submission_id for row in board(database, "lattice") if row.rank}


def test_ranks_of_a_submission_are_those_of_the_board(database: Database) -> None:
    expected = {row.submission_id: row.rank for row in board(database, "lattice")}
    with database.read() as session:
        records = [session.get_one(SubmissionRecord, f"s{place}") for place in range(len(ERRORS))]
    found = {record.id: ranks(database, record) for record in records}
    for name, ranked in found.items():
        assert ranked == ({"lattice": expected[name]} if expected.get(name) else {})


def test_a_place_in_the_queue_counts_who_waits_before(database: Database) -> None:
    waiting = [submission(f"q{k}", 200.0 + k, status="queued") for k in range(3)]
    with database.write() as session:
        session.add_all(waiting)
        session.add(submission("q-", 150.0, status="scoring"))
    places = [queue_place(database, one) for one in waiting]
    assert [(place.number, place.waiting) for place in places if place] == [(1, 3), (2, 3), (3, 3)]
    assert queue_place(database, submission("s0", 1.0)) is None


def test_a_board_shows_the_first_rows_and_says_how_many_there_are(database: Database) -> None:
    whole, cut = (make_board(database, "lattice", Order(), most) for most in (None, 2))
    assert [line.submission_id for line in cut.lines] == ["s2", "s0"]
    assert (whole.rows, cut.rows) == (6, 6)
    assert [line.mark for line in whole.lines] == ["1", "2", "3", "4", "a", "b"]
    assert whole.plotted == min(6, MOST_PLOTTED)
    assert [row.mark for row in whole.published] == list("ABCDEF")


@given(st.lists(st.one_of(st.none(), st.floats(0.01, 9.0)), max_size=12), st.sampled_from(sorted(COLUMNS)))
def test_missing_values_come_last_whichever_way(errors: list[float | None], name: str) -> None:
    views = [
        scored("lattice/0000", error, coverage=error / 9) if error else unpredicted("lattice/0000")
        for error in errors
    ]
    rows = [(None, table_row(f"m{k}", tabulate([view]))) for k, view in enumerate(views)]
    for order in (Order(name), Order(name, True)):
        values = [COLUMNS[name].value(rows[place][1]) for place in ordered(rows, order)]
        present = [value for value in values if value is not None]
        assert values == present + [None] * (len(values) - len(present))
        assert present == sorted(present, reverse=order.falling)


def test_a_heading_s_link_turns_the_order() -> None:
    assert (Order("rmse").link("rmse"), Order("rmse", True).link("rmse")) == ("-rmse", "rmse")
    assert (Order("rmse").heading("rmse"), Order("delta1").heading("delta1")) == ("ascending", "descending")
    assert Order("rmse").heading("mae") is None
    assert [read_order(text) for text in (None, "nope", "-", "-mae")] == [
        Order(),
        Order(),
        Order(),
        Order("mae", True),
    ]
    assert read_order("-rank") == Order(RANK, True)


def test_a_result_is_read_back_as_it_was() -> None:
    original = result(scored("lattice/0000"), unpredicted("lattice/0001"), overflowed("pile/0000"))
    again = read_result(original.to_json(), "a result")
    assert again.to_json() == original.to_json()
    for config, table in original.tables.items():
        assert table_row(config, again.tables[config]).reasons == table_row(config, table).reasons


def body(*parts: tuple[str, bytes]) -> bytes:
    found = b"".join(
        b'--B\r\nContent-Disposition: form-data; name="%s"\r\n\r\n%s\r\n' % (name.encode(), content)
        for name, content in parts
    )
    return found + b"--B--\r\n"


def first_field(content: bytes, step: int, kind: str = "multipart/form-data; boundary=B") -> tuple[str, bytes]:
    async def read() -> tuple[str, bytes]:
        async def chunks() -> AsyncIterator[bytes]:
            for start in range(0, len(content), step):
                yield content[start : start + step]

        text, whole = await leading_field(chunks(), kind, "token")
        return text, b"".join([chunk async for chunk in whole])

    return asyncio.run(read())


@settings(max_examples=40)
@given(st.binary(max_size=300), st.text("abcXYZ-_09", max_size=60), st.integers(1, 400))
def test_the_first_field_is_told_and_the_body_comes_again_whole(archive: bytes, token: str, step: int) -> None:
    content = body(("token", token.encode()), ("archive", archive))
    assert first_field(content, step) == (token, content)


@pytest.mark.parametrize(
    "parts",
    [
        [("archive", b"zip"), ("token", b"late")],
        [("token", b"x" * (MOST_FIELD + 1))],
        [("other", b"x"), ("token", b"second")],
        [("archive", b"z" * 300_000), ("token", b"late")],
    ],
)
def test_a_first_field_that_is_another_or_too_long_is_none(parts: list[tuple[str, bytes]]) -> None:
    content = body(*parts)
    assert first_field(content, 1000) == ("", content)


def test_a_body_that_is_no_form_is_refused_in_words() -> None:
    with pytest.raises(UploadError, match="expected multipart/form-data"):
        first_field(b"{}", 10, "application/json")
    with pytest.raises(UploadError, match="no multipart/form-data"):
        first_field(b"hello", 10)


@pytest.mark.parametrize("url", [None, "", "javascript:alert(1)", "data:text/html,x", "//x.org", "ftp://x.org"])
def test_only_http_addresses_are_linked(url: str | None) -> None:
    assert link(url) is None


def test_texts_keep_their_lines_and_lose_what_turns_them() -> None:
    assert lines("a\nb\u202ec\x00") == "a\nb\ufffdc\ufffd"
    assert len(lines("x" * 10_000)) == 4000
    assert lines(None) == ""
    found = link("https://example.org/a?b=1")
    assert found is not None
    assert found.host == "example.org"
    assert moment(0.0).text == "1970-01-01 00:00 UTC"
    assert [size(n) for n in (999, 1024, 8 << 30, 22_120_682)] == ["999 bytes", "1 KiB", "8 GiB", "21.1 MiB"]
