"""Components of pages: sort orders, ranks, the first field of the form, and untrusted text."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest
from fastapi import Request
from hypothesis import given, settings
from hypothesis import strategies as st

from leaderboard.db.engine import Database
from leaderboard.db.models import LeaderboardRowModel, ResultModel, SubmissionModel, TokenModel
from leaderboard.db.rankings import leaderboard_entries, queue_position, ranks
from leaderboard.uploads.multipart import MAX_FIELD_BYTES, UploadRejectedError, read_leading_field
from leaderboard.web.pages.leaderboard import (
    COLUMNS,
    MAX_PLOTTED,
    RANK,
    Order,
    make_config_ranking,
    parse_order,
    sort_indices,
)
from leaderboard.web.pages.rendering import clean_text, error_response, format_size, format_time, link
from rebar_depth_bench.errors import Problem
from rebar_depth_bench.reporting.html.rows import table_row
from rebar_depth_bench.scoring.result import tabulate
from rebar_depth_bench.scoring.result_io import read_result
from tests.bench.reporting.results import overflowed_view, result, scored_view, unpredicted_view

ERRORS = [0.3, 0.1, 0.1, 2.0, 0.7, None, 0.05]
UNRANKED, HIDDEN = (5, 6), (1,)


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    """Yield a database of seven submissions of ``lattice``: two unranked, one not public."""
    opened = Database(f"sqlite:///{tmp_path / 'db.sqlite'}")
    opened.migrate()
    with opened.write() as session:
        session.add(TokenModel(id=1, name="alice", sha256="0" * 64, created_at=0.0))
        session.flush()
        for index, error in enumerate(ERRORS):
            result_dict = result(scored_view("lattice/0000", error or 0.5), method=f"m{index}").to_dict()
            table = {**result_dict["tables"]["lattice"], "ranked": index not in UNRANKED}
            session.add(make_submission(f"s{index}", 100.0 + index, public=index not in HIDDEN))
            session.flush()
            session.add(ResultModel(submission_id=f"s{index}", json=json.dumps(result_dict).encode()))
            session.add(
                LeaderboardRowModel(
                    submission_id=f"s{index}",
                    config="lattice",
                    ranked=table["ranked"],
                    rank_error=error,
                    json=json.dumps(table),
                )
            )
    yield opened
    opened.close()


def make_submission(
    name: str, created_at: float, *, public: bool = True, status: str = "scored"
) -> SubmissionModel:
    return SubmissionModel(
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


def test_leaderboard_entries_are_public_and_in_order(database: Database) -> None:
    shown = [(row.rank, row.submission_id) for row in leaderboard_entries(database, "lattice")]
    assert shown == [(1, "s2"), (2, "s0"), (3, "s4"), (4, "s3"), (None, "s6"), (None, "s5")]


def test_ranks_of_submission_match_leaderboard(database: Database) -> None:
    expected = {row.submission_id: row.rank for row in leaderboard_entries(database, "lattice")}
    with database.read() as session:
        records = [session.get_one(SubmissionModel, f"s{index}") for index in range(len(ERRORS))]
    ranks_by_id = {record.id: ranks(database, record) for record in records}
    for name, submission_ranks in ranks_by_id.items():
        assert submission_ranks == ({"lattice": expected[name]} if expected.get(name) else {})


def test_queue_position_counts_earlier_submissions(database: Database) -> None:
    waiting = [make_submission(f"q{k}", 200.0 + k, status="queued") for k in range(3)]
    with database.write() as session:
        session.add_all(waiting)
        session.add(make_submission("q-", 150.0, status="scoring"))
    positions = [queue_position(database, record) for record in waiting]
    assert [(position.number, position.waiting) for position in positions if position] == [(1, 3), (2, 3), (3, 3)]
    assert queue_position(database, make_submission("s0", 1.0)) is None


def test_equal_errors_share_a_rank_overall_and_in_their_class(database: Database) -> None:
    with database.write() as session:
        for name, error, inputs in (("s0", 0.25, "rgb"), ("s2", 0.25, "stereo"), ("s3", 0.5, "rgb")):
            row = session.get_one(LeaderboardRowModel, (name, "lattice"))
            row.rank_error, row.ranked = error, True
            record = session.get_one(SubmissionModel, name)
            record.inputs, record.public = inputs, True
    entries = {entry.submission_id: entry for entry in leaderboard_entries(database, "lattice")}
    assert (entries["s0"].rank, entries["s2"].rank) == (1, 1)
    assert entries["s3"].rank is not None
    assert entries["s3"].rank >= 3
    assert (entries["s0"].class_rank, entries["s2"].class_rank, entries["s3"].class_rank) == (1, 1, 2)
    assert {entry.class_rank for entry in entries.values() if entry.inputs is None} == {None}
    with database.read() as session:
        records = [session.get_one(SubmissionModel, name) for name in ("s0", "s2", "s3")]
    assert [ranks(database, record)["lattice"] for record in records] == [1, 1, entries["s3"].rank]
    shown = make_config_ranking(database, "lattice", Order(), "rgb")
    assert [line.submission_id for line in shown.lines] == ["s0", "s3"]
    assert [line.rank for line in shown.lines] == [1, entries["s3"].rank]


def test_limited_ranking_shows_first_rows_and_total_count(database: Database) -> None:
    full, limited = (make_config_ranking(database, "lattice", Order(), None, max_rows) for max_rows in (None, 2))
    assert [line.submission_id for line in limited.lines] == ["s2", "s0"]
    assert (full.row_count, limited.row_count) == (6, 6)
    assert [line.mark for line in full.lines] == ["1", "2", "3", "4", "a", "b"]
    assert full.plotted == min(6, MAX_PLOTTED)
    assert [row.mark for row in full.published] == list("ABCDEF")


@pytest.mark.slow
@given(st.lists(st.one_of(st.none(), st.floats(0.01, 9.0)), max_size=12), st.sampled_from(sorted(COLUMNS)))
def test_missing_values_are_sorted_last_in_both_orders(errors: list[float | None], name: str) -> None:
    views = [
        scored_view("lattice/0000", error, coverage=error / 9) if error else unpredicted_view("lattice/0000")
        for error in errors
    ]
    rows = [(None, table_row(f"m{k}", tabulate([view]))) for k, view in enumerate(views)]
    for order in (Order(name), Order(name, True)):
        values = [COLUMNS[name].value(rows[index][1]) for index in sort_indices(rows, order)]
        present = [value for value in values if value is not None]
        assert values == present + [None] * (len(values) - len(present))
        assert present == sorted(present, reverse=order.is_descending)


def test_heading_link_reverses_sort_order() -> None:
    assert (Order("rmse").link("rmse"), Order("rmse", True).link("rmse")) == ("-rmse", "rmse")
    assert (Order("rmse").heading("rmse"), Order("delta1").heading("delta1")) == ("ascending", "descending")
    assert Order("rmse").heading("mae") is None
    assert [parse_order(text) for text in (None, "nope", "-", "-mae")] == [
        Order(),
        Order(),
        Order(),
        Order("mae", True),
    ]
    assert parse_order("-rank") == Order(RANK, True)


def test_result_json_round_trips() -> None:
    original = result(scored_view("lattice/0000"), unpredicted_view("lattice/0001"), overflowed_view("pile/0000"))
    read_back = read_result(original.to_json(), "a result")
    assert read_back.to_json() == original.to_json()
    for config, table in original.tables.items():
        assert table_row(config, read_back.tables[config]).notes == table_row(config, table).notes


def multipart_body(*parts: tuple[str, bytes]) -> bytes:
    encoded_parts = b"".join(
        b'--B\r\nContent-Disposition: form-data; name="%s"\r\n\r\n%s\r\n' % (name.encode(), content)
        for name, content in parts
    )
    return encoded_parts + b"--B--\r\n"


def first_field(content: bytes, step: int, kind: str = "multipart/form-data; boundary=B") -> tuple[str, bytes]:
    async def read() -> tuple[str, bytes]:
        async def chunks() -> AsyncIterator[bytes]:
            for start in range(0, len(content), step):
                yield content[start : start + step]

        value, body_chunks = await read_leading_field(chunks(), kind, "token")
        return value, b"".join([chunk async for chunk in body_chunks])

    return asyncio.run(read())


@settings(max_examples=40)
@given(st.binary(max_size=300), st.text("abcXYZ-_09", max_size=60), st.integers(1, 400))
def test_first_field_is_read_and_body_is_replayed(archive: bytes, token: str, step: int) -> None:
    content = multipart_body(("token", token.encode()), ("archive", archive))
    assert first_field(content, step) == (token, content)


@pytest.mark.parametrize(
    "parts",
    [
        [("archive", b"zip"), ("token", b"late")],
        [("token", b"x" * (MAX_FIELD_BYTES + 1))],
        [("other", b"x"), ("token", b"second")],
        [("archive", b"z" * 300_000), ("token", b"late")],
    ],
)
def test_other_or_too_long_first_field_is_empty(parts: list[tuple[str, bytes]]) -> None:
    content = multipart_body(*parts)
    assert first_field(content, 1000) == ("", content)


def test_non_multipart_body_is_rejected() -> None:
    with pytest.raises(UploadRejectedError, match="expected multipart/form-data"):
        first_field(b"{}", 10, "application/json")
    with pytest.raises(UploadRejectedError, match="not valid multipart/form-data"):
        first_field(b"hello", 10)


@pytest.mark.parametrize("url", [None, "", "javascript:alert(1)", "data:text/html,x", "//x.org", "ftp://x.org"])
def test_only_http_urls_are_linked(url: str | None) -> None:
    assert link(url) is None


def test_clean_text_keeps_newlines_and_removes_controls() -> None:
    assert clean_text("a\nb\u202ec\x00") == "a\nb\ufffdc\ufffd"
    assert len(clean_text("x" * 10_000)) == 4000
    assert clean_text(None) == ""
    parsed_link = link("https://example.org/a?b=1")
    assert parsed_link is not None
    assert parsed_link.host == "example.org"
    assert format_time(0.0).text == "1970-01-01 00:00 UTC"
    assert [format_size(n) for n in (999, 1024, 8 << 30, 22_120_682)] == [
        "999 bytes",
        "1 KiB",
        "8 GiB",
        "21.1 MiB",
    ]


@pytest.mark.parametrize(("limit", "shown"), [(20, 20), (None, 23)])
def test_error_response_lists_text_and_details_in_same_order(limit: int | None, shown: int) -> None:
    request = Request({"type": "http", "path": "/api/v1/submissions", "headers": []})
    problems = [Problem("invalid", f"{index}.npy", "the dtype is <i4", "float32") for index in range(23)]
    content = json.loads(bytes(error_response(request, 422, "invalid", None, problems, limit).body))
    assert list(content) == ["detail", "problems", "problem_details"]
    assert [Problem(**detail) for detail in content["problem_details"]] == problems[:shown]
    assert content["problems"][:shown] == [str(problem) for problem in problems[:shown]]
    assert content["problems"][shown:] == (["... and 3 more"] if limit else [])
