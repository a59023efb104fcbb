"""Rankings: order, ranks and their ranges, pages of rows, charts, and the selection in the address of a page."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from leaderboard.db.view_errors import rank_ranges, view_errors

from leaderboard.db.engine import Database
from leaderboard.db.models import LeaderboardRowModel, ResultModel, SubmissionModel, TokenModel
from leaderboard.db.rankings import LeaderboardEntry, Ranking, queue_position, read_ranking
from leaderboard.web.pages.ranking import make_config_ranking
from leaderboard.web.pages.selection import COLUMNS, RANK, Selection, parse_selection
from rebar_depth_bench.scoring.bootstrap import interval, resample
from rebar_depth_bench.scoring.comparison import compare
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.scoring.score import tabulate
from tests.bench.reporting.results import result, scored_view, unpredicted_view

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


def test_interval_with_an_overflowed_end_is_not_plotted() -> None:
    tables = [result(scored_view("lattice/0000")).to_dict()["tables"]["lattice"] for _ in range(2)]
    tables[0]["ci95"]["native"]["abs_rel"] = [0.7, None]
    tables[1]["ci95"]["native"]["abs_rel"] = [0.7, 0.8]
    ranking = Ranking(tuple(entry_of(f"m{k}", table) for k, table in enumerate(tables)))
    chart = make_config_ranking(ranking, "lattice", Selection(), False).chart
    assert chart is not None
    assert chart.count('class="bars"') == 1


VIEWS = 40


def random_results(count: int, spread: float, seed: int) -> list[Result]:
    """Return results whose errors vary in common with the view and on their own."""
    rng = np.random.default_rng(seed)
    difficulty = rng.uniform(0.1, 0.3, VIEWS)
    results = []
    for number in range(count):
        errors = np.clip(difficulty + spread * number + rng.normal(0, 0.05, VIEWS), 0.01, 0.9)
        views = [scored_view(f"lattice/{12 * index:04d}", float(error)) for index, error in enumerate(errors)]
        results.append(result(*views, method=f"m{number}"))
    return results


def compared_range(index: int, results: Sequence[Result], config: str) -> tuple[tuple[int, int], list[str]]:
    """Return the ranks of a result that the verdicts of ``compare`` with the others allow, and these verdicts."""
    verdicts: list[str] = [
        next(
            row for row in compare(results[index], one).configs[config] if row.column.path == "rank_error"
        ).verdict
        for number, one in enumerate(results)
        if number != index
    ]
    return (1 + verdicts.count("better"), len(results) - verdicts.count("worse")), verdicts


@pytest.mark.slow
@pytest.mark.parametrize("spread", [0.0, 0.01, 0.05])
def test_ranges_agree_with_the_paired_comparison(spread: float) -> None:
    results = random_results(8, spread, seed=3)
    ranges = rank_ranges([view_errors(one.to_dict(), "lattice") for one in results])
    assert ranges == [compared_range(index, results, "lattice")[0] for index in range(len(results))]


@pytest.mark.slow
def test_pairs_on_few_skewed_views_are_those_of_the_interval() -> None:
    """Pairs that are decided without draws are those whose interval excludes zero, also for eight blocks."""
    ids = [f"lattice/{index:04d}" for index in range(0, 96, 12)]
    resampling = resample(range(0, 96, 12))
    for seed in range(30):
        rng = np.random.default_rng(seed)
        spread = np.where(np.arange(12) % 2, 0.1, 0.03)[:, None]
        errors = rng.exponential(0.1, 8) + 0.03 * np.arange(12)[:, None] + spread * rng.exponential(size=(12, 8))
        means = resampling.means(errors.T).T
        intervals = [[interval(a - b, resampling.blocks()) for b in means] for a in means]
        better = np.array([[bounds is not None and bounds[1] < 0 for bounds in row] for row in intervals])
        expected = list(zip(1 + better.sum(0), len(means) - better.sum(1), strict=True))
        assert rank_ranges([json.dumps([ids, row.tolist()]) for row in errors]) == expected


@pytest.mark.slow
def test_range_contains_the_rank() -> None:
    results = random_results(60, 0.002, seed=5)
    errors = [one.tables["lattice"].rank_error or 0.0 for one in results]
    ranges = rank_ranges([view_errors(one.to_dict(), "lattice") for one in results])
    for error, rank_range in zip(errors, ranges, strict=True):
        assert rank_range is not None
        assert rank_range[0] <= 1 + sum(other < error for other in errors) <= rank_range[1]


@pytest.mark.slow
def test_scenes_are_resampled_in_a_config_with_splits() -> None:
    """Views of a scene share their error: two submissions that differ in few scenes are not told apart."""
    rng = np.random.default_rng(4)
    scenes, results = 10, []
    for number in range(3):
        of_scene = rng.uniform(0.1, 0.3, scenes) + 0.03 * number
        ids = [f"cages/test-s{scene}-{index:04d}" for scene in range(scenes) for index in range(8)]
        views = [scored_view(view_id, float(of_scene[n // 8])) for n, view_id in enumerate(ids)]
        results.append(replace(result(), tables={"cages": tabulate(views, split="test")}, views=views))
    ranges = rank_ranges([view_errors(one.to_dict(), "cages") for one in results])
    expected = [compared_range(index, results, "cages") for index in range(len(results))]
    assert ranges == [compared for compared, _ in expected]
    assert "undecided" in expected[-1][1]


def test_too_few_views_allow_every_rank() -> None:
    results = [result(scored_view("lattice/0000", error)) for error in (0.1, 0.5)]
    assert rank_ranges([view_errors(one.to_dict(), "lattice") for one in results]) == [(1, 2), (1, 2)]


def test_rows_without_view_errors_or_with_other_views_have_no_range() -> None:
    full, part = random_results(1, 0, 1)[0], result(scored_view("lattice/0000"))
    packed = [view_errors(one.to_dict(), "lattice") for one in (full, full, part)]
    assert rank_ranges([*packed, None])[2:] == [None, None]
    assert rank_ranges(packed)[:2] == [(1, 2), (1, 2)]
    assert rank_ranges(packed[:1]) == [None]
    assert json.loads(packed[2] or "") == [["lattice/0000"], [part.to_dict()["views"][0]["rank_error"]]]
