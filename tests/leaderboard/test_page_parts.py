"""Components of pages: sort orders, ranks, the first field of the form, and untrusted text."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

import pytest
from fastapi import Request
from hypothesis import given, settings
from hypothesis import strategies as st

from leaderboard.db.engine import Database
from leaderboard.db.models import LeaderboardRowModel, ResultModel, SubmissionModel, TokenModel
from leaderboard.db.rankings import LeaderboardEntry, Ranking, queue_position, read_ranking
from leaderboard.refusals import RefusedError
from leaderboard.uploads.multipart import MAX_FIELD_BYTES, UploadForm
from leaderboard.web.pages.ranking import make_config_ranking
from leaderboard.web.pages.rendering import clean_text, error_response, format_size, link_html, time_html
from leaderboard.web.pages.selection import COLUMNS, RANK, Selection, parse_selection
from rebar_depth_bench.base.errors import Problem
from rebar_depth_bench.reporting.formatting import table_notes
from rebar_depth_bench.scoring.result import read_result
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
            result_json = json.dumps(result_dict).encode()
            session.add(ResultModel(submission_id=f"s{index}", json=result_json))
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
    shown = [(row.rank, row.id) for row in read_ranking(database, "lattice", "sha256:0").entries]
    assert shown == [(1, "s2"), (2, "s0"), (3, "s4"), (4, "s3"), (None, "s6"), (None, "s5")]


def test_queue_position_counts_earlier_submissions(database: Database) -> None:
    waiting = [make_submission(f"q{k}", 200.0 + k, status="queued") for k in range(3)]
    with database.write() as session:
        session.add_all(waiting)
        session.add(make_submission("q-", 150.0, status="scoring"))
    positions = [queue_position(database, record) for record in waiting]
    assert [position for position in positions if position] == [(1, 3), (2, 3), (3, 3)]
    assert queue_position(database, make_submission("s0", 1.0)) is None


def test_equal_errors_share_a_rank_overall_and_in_their_class(database: Database) -> None:
    with database.write() as session:
        for name, error, inputs in (("s0", 0.25, "rgb"), ("s2", 0.25, "stereo"), ("s3", 0.5, "rgb")):
            row = session.get_one(LeaderboardRowModel, (name, "lattice"))
            row.rank_error, row.ranked = error, True
            record = session.get_one(SubmissionModel, name)
            record.inputs, record.public = inputs, True
    entries = {entry.id: entry for entry in read_ranking(database, "lattice", "sha256:0").entries}
    assert (entries["s0"].rank, entries["s2"].rank) == (1, 1)
    assert entries["s3"].rank is not None
    assert entries["s3"].rank >= 3
    assert (entries["s0"].class_rank, entries["s2"].class_rank, entries["s3"].class_rank) == (1, 1, 2)
    assert {entry.class_rank for entry in entries.values() if entry.inputs is None} == {None}
    shown = make_config_ranking(
        read_ranking(database, "lattice", "sha256:0"), "lattice", Selection(inputs="rgb"), False
    )
    assert [line.entry.id for line in shown.lines] == ["s0", "s3"]
    assert [line.entry.rank for line in shown.lines] == [1, entries["s3"].rank]


def test_pages_divide_the_rows(database: Database) -> None:
    ranking = read_ranking(database, "lattice", "sha256:0")
    full = make_config_ranking(ranking, "lattice", Selection(), False)
    pages = [make_config_ranking(ranking, "lattice", Selection(page=page), False, 4) for page in (1, 2, 3)]
    assert [[line.entry.id for line in page.lines] for page in pages] == [
        ["s2", "s0", "s4", "s3"],
        ["s6", "s5"],
        ["s6", "s5"],
    ]
    assert [page.selection.page for page in pages] == [1, 2, 2]
    assert {(page.row_count, page.pages, page.plotted) for page in pages} == {(6, 2, 6)}
    assert full.pages == 1
    assert [row.mark for row in full.published] == list("ABCDEF")


@pytest.mark.parametrize(("most", "has_chart"), [(None, True), (6, True), (5, False)])
def test_chart_has_all_rows_or_is_left_out(database: Database, most: int | None, has_chart: bool) -> None:
    ranking = read_ranking(database, "lattice", "sha256:0")
    shown = make_config_ranking(ranking, "lattice", Selection(), False, page_rows=2, max_plotted=most)
    assert (shown.plotted, shown.chart is not None) == (6, has_chart)
    if shown.chart:
        assert shown.chart.count('class="native fill"') == 6


def test_search_selects_by_method_and_submitter(database: Database) -> None:
    ranking = read_ranking(database, "lattice", "sha256:0")
    found = {
        text: make_config_ranking(ranking, "lattice", Selection(text=text), False).row_count
        for text in ("S2", "alice", "nobody")
    }
    assert found == {"S2": 1, "alice": 6, "nobody": 0}


@pytest.mark.slow
@given(st.lists(st.one_of(st.none(), st.floats(0.01, 9.0)), max_size=12), st.sampled_from(sorted(COLUMNS)))
def test_missing_values_are_sorted_last_in_both_orders(errors: list[float | None], name: str) -> None:
    views = [
        scored_view("lattice/0000", error, coverage=error / 9) if error else unpredicted_view("lattice/0000")
        for error in errors
    ]
    tables = [result(view).to_dict()["tables"]["lattice"] for view in views]
    entries = [entry_of(f"m{k}", table) for k, table in enumerate(tables)]
    for selection in (Selection(name), Selection(name, inverted=True)):
        values = [COLUMNS[name].value(entry.table) for entry in selection.sorted(entries)]
        present = [value for value in values if value is not None]
        assert values == present + [None] * (len(values) - len(present))
        assert present == sorted(present, reverse=selection.is_descending)


def entry_of(name: str, table: dict[str, Any]) -> LeaderboardEntry:
    return LeaderboardEntry(
        *(name, "lattice", name, "alice", "{}", None, None, 0.0, True, True, None, None, json.dumps(table))
    )


def test_heading_link_reverses_sort_order() -> None:
    rmse = Selection("rmse", page=3)
    assert rmse.sorted_by("rmse").query() == "sort=-rmse"
    assert rmse.sorted_by("rmse").sorted_by("rmse").query() == "sort=rmse"
    assert (rmse.heading("rmse"), Selection("delta1").heading("delta1")) == ("ascending", "descending")
    assert rmse.heading("mae") is None
    assert [parse_selection(text, None, None, None) for text in (None, "nope", "-", "-mae", "-rank")] == [
        Selection(),
        Selection(),
        Selection(),
        Selection("mae", inverted=True),
        Selection(RANK, inverted=True),
    ]


@given(
    st.sampled_from([RANK, "method", *COLUMNS]),
    st.booleans(),
    st.sampled_from([None, "rgb", "rgb+K"]),
    st.text("ab &=?+%#äß", max_size=12),
    st.integers(1, 99),
)
def test_query_of_a_selection_is_read_back(
    order: str, inverted: bool, inputs: str | None, text: str, page: int
) -> None:
    selection = Selection(order, inverted, inputs, text.strip(), page)
    values = dict(parse_qsl(selection.query(config="lattice")))
    assert values.pop("config") == "lattice"
    page_text = values.get("page")
    assert selection == parse_selection(
        values.get("sort"), values.get("inputs"), values.get("q"), int(page_text) if page_text else None
    )


def test_result_json_round_trips() -> None:
    original = result(scored_view("lattice/0000"), unpredicted_view("lattice/0001"), overflowed_view("pile/0000"))
    read_back = read_result(original.to_json(), "a result")
    assert read_back.to_json() == original.to_json()
    for config, table in original.tables.items():
        assert table_notes(read_back.tables[config]) == table_notes(table)


def multipart_body(*parts: tuple[str, bytes]) -> bytes:
    encoded_parts = b"".join(
        b'--B\r\nContent-Disposition: form-data; name="%s"\r\n\r\n%s\r\n' % (name.encode(), content)
        for name, content in parts
    )
    return encoded_parts + b"--B--\r\n"


def read_form(
    content: bytes, step: int, kind: str = "multipart/form-data; boundary=B", *, with_token: bool = True
) -> tuple[str, bytes]:
    """Return token and archive of a form that arrives in parts of ``step`` bytes."""

    async def read() -> tuple[str, bytes]:
        async def chunks() -> AsyncIterator[bytes]:
            for start in range(0, len(content), step):
                yield content[start : start + step]

        form = UploadForm(chunks(), kind)
        token = await form.token() if with_token else ""
        return token, b"".join([part async for part in form.archive()])

    return asyncio.run(read())


@settings(max_examples=40)
@given(st.binary(max_size=300), st.text("abcXYZ-_09", max_size=60), st.integers(1, 400), st.booleans())
def test_form_is_read_in_any_parts(archive: bytes, token: str, step: int, with_token: bool) -> None:
    content = multipart_body(("token", token.encode()), ("archive", archive))
    assert read_form(content, step, with_token=with_token) == (token if with_token else "", archive)


@pytest.mark.parametrize(
    "parts",
    [
        [("archive", b"zip"), ("token", b"late")],
        [("token", b"x" * (MAX_FIELD_BYTES + 1)), ("archive", b"zip")],
        [("other", b"x"), ("archive", b"zip")],
        [("archive", b"z" * 300_000), ("token", b"late")],
    ],
)
def test_token_after_the_archive_or_too_long_is_empty(parts: list[tuple[str, bytes]]) -> None:
    assert read_form(multipart_body(*parts), 1000) == ("", dict(parts)["archive"])


def test_form_without_or_with_two_archives_is_rejected() -> None:
    with pytest.raises(RefusedError, match="no field 'archive'"):
        read_form(multipart_body(("token", b"x")), 10)
    with pytest.raises(RefusedError, match="twice"):
        read_form(multipart_body(("archive", b"a"), ("archive", b"b")), 10)


def test_non_multipart_body_is_rejected() -> None:
    with pytest.raises(RefusedError, match="expected multipart/form-data"):
        read_form(b"{}", 10, "application/json")
    with pytest.raises(RefusedError, match="not valid multipart/form-data"):
        read_form(b"hello", 10)


@pytest.mark.parametrize("url", [None, "", "javascript:alert(1)", "data:text/html,x", "//x.org", "ftp://x.org"])
def test_only_http_urls_are_linked(url: str | None) -> None:
    assert link_html(url) == ""


def test_clean_text_keeps_newlines_and_removes_controls() -> None:
    assert clean_text("a\nb\u202ec\x00") == "a\nb\ufffdc\ufffd"
    assert len(clean_text("x" * 10_000)) == 4000
    assert clean_text(None) == ""
    assert ">example.org</a>" in link_html("https://example.org/a?b=1")
    assert time_html(0.0) == '<time datetime="1970-01-01T00:00:00Z">1970-01-01 00:00 UTC</time>'
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


def test_interval_with_an_overflowed_end_is_not_plotted() -> None:
    tables = [result(scored_view("lattice/0000")).to_dict()["tables"]["lattice"] for _ in range(2)]
    tables[0]["ci95"]["native"]["abs_rel"] = [0.7, None]
    tables[1]["ci95"]["native"]["abs_rel"] = [0.7, 0.8]
    ranking = Ranking(tuple(entry_of(f"m{k}", table) for k, table in enumerate(tables)))
    chart = make_config_ranking(ranking, "lattice", Selection(), False).chart
    assert chart is not None
    assert chart.count('class="bars"') == 1
