"""Results: tables, JSON content, what is read back and what is refused."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.scoring.reading import read_result, read_table
from rebar_depth_bench.submission import Declaration
from tests.bench.reporting.results import overflowed_view, result, scored_view, table_of, unpredicted_view


def test_table_has_mean_metrics_and_median_scale() -> None:
    views = [
        scored_view(f"lattice/000{n}", value, scale=scale)
        for n, value, scale in ((0, 1.0, 0.5), (1, 2.0, 0.7), (2, 6.0, 4.0))
    ]
    table = table_of(views)
    assert (table["native.abs_rel"], table["scale_median"]) == (3.0, 0.7)
    assert (table.views, table.views_scored, table.ranked) == (3, 3, True)
    assert table_of(views[:2])["scale_median"] == pytest.approx(0.6), "the mean of the middle two"
    for seed in range(20):
        errors = np.random.default_rng(seed).lognormal(0, 2, 20)
        views = [scored_view(f"lattice/{n:04d}", error) for n, error in enumerate(errors.tolist())]
        assert table_of(views) == table_of(views[::-1]), "the mean depends on no order"


@pytest.mark.parametrize(("coverage", "comparable"), [(0.95, True), (math.nextafter(0.95, 0), False)])
def test_errors_are_comparable_from_coverage_threshold(coverage: float, comparable: bool) -> None:
    table = table_of([scored_view(f"lattice/000{n}", coverage=coverage) for n in range(2)])
    assert (table.is_comparable, table.ranked) == (comparable, True)


@pytest.mark.parametrize(("uses_ground_truth", "ranked"), [(None, True), (False, True), (True, False)])
def test_declared_use_of_ground_truth_is_not_ranked(uses_ground_truth: bool | None, ranked: bool) -> None:
    assert table_of([scored_view("lattice/0000")], Declaration("rgb", uses_ground_truth)).ranked is ranked


def test_view_without_prediction_is_not_averaged_but_counts_in_rank_error() -> None:
    views = [scored_view(f"lattice/{n:04}", 1.0) for n in range(99)] + [unpredicted_view("lattice/0099")]
    table = table_of(views)
    assert (table["native.abs_rel"], table.views_scored, table.views) == (1.0, 99, 100)
    assert (table.ranked, table.is_comparable) == (True, False)
    assert table["rank_error"] == pytest.approx((99 * 0.5 + 1) / 100)
    assert table["coverage"] == pytest.approx(0.99)


def test_infinite_view_makes_mean_null() -> None:
    views = [scored_view("lattice/0000", 1.0), scored_view("lattice/0001", math.inf)]
    table = result(*views).tables["lattice"]
    assert (table.ranked, table.is_comparable, table["rank_error"]) == (True, False, 0.75)
    native = result(*views).to_dict()["tables"]["lattice"]["native"]
    assert (native["abs_rel"], native["delta1"]) == (None, 0.1234)


def test_json_keys_and_units_match_contract() -> None:
    content = json.loads(result(scored_view("config/0000")).to_json())
    assert list(content) == ["protocol", "dataset", "submission", "software", "intervals", "tables", "views"]
    assert content["intervals"] == {"method": "expanded-percentile-2", "draws": 2000, "level": 0.95}
    assert content["protocol"] == "rebar-2"
    assert content["dataset"] == {"digest": "sha256:" + "fedcba9876543210" * 4, "version": "1.2.3"}
    about = {"method": "my model", "sha256": "0123456789abcdef" * 4, "inputs": "rgb+K", "uses_ground_truth": False}
    assert content["submission"] == about
    table, [view] = content["tables"]["config"], content["views"]
    numbers = "views views_scored coverage ranked rank_error native scaled scale_median within_mm"
    assert " ".join(table) == f"{numbers} reference published ci95"
    assert table["native"] == {"abs_rel": 0.75, "rmse_cm": 20.09, "mae_cm": 18.71, "delta1": 0.1234}
    assert list(table["within_mm"]) == ["3", "5", "10", "20"]
    assert list(table["ci95"]) == ["coverage", "rank_error", "native", "scaled", "scale_median", "within_mm"]
    assert " ".join(view) == "view_id scored_px coverage rank_error scale native scaled within_mm"


VIEWS = [scored_view("lattice/0000"), unpredicted_view("lattice/0001"), overflowed_view("pile/0000")]
SOUND = result(*VIEWS).to_json()
TABLE = json.loads(SOUND)["tables"]["lattice"]

Change = Callable[[dict[str, Any]], object]


def refused(content: bytes) -> list[str]:
    """Return code and place of each problem; they must be found within a second and printed on short lines."""
    start = time.process_time()
    with pytest.raises(InputError, match=r"https://x\.org") as caught:
        read_result(content, "https://x.org")
    assert time.process_time() - start < 1
    assert all(str(problem).isprintable() and len(str(problem)) < 300 for problem in caught.value.problems)
    return [f"{problem.code} {problem.where}" for problem in caught.value.problems]


def test_written_result_is_read_unchanged() -> None:
    assert read_result(SOUND, "x").to_json() == SOUND
    views = [scored_view(f"lattice/{index:04d}", 0.01 * index) for index in range(30)]
    many = result(*views, unpredicted_view("pile/0000"), method="Größe 2").to_json()
    assert read_result(many, "x").to_json() == many


def test_errors_of_views_without_predictions_are_left_out() -> None:
    document = json.loads(SOUND)
    document["views"][1]["native"] = dict.fromkeys(document["views"][0]["native"], 0.5)
    assert read_result(json.dumps(document).encode(), "x").to_json() == SOUND


@pytest.mark.parametrize("kind", ["metric", "scale", "affine-depth"])
def test_table_without_views_is_null_unranked_and_read_unchanged(kind: str) -> None:
    prediction, protocol = (None, "rebar-2") if kind == "metric" else (kind, "rebar-relative-1")
    empty = replace(
        result(), prediction=prediction, protocol=protocol, tables={"lattice": table_of([], kind=kind)}
    )
    table = empty.to_dict()["tables"]["lattice"]
    assert (table["views"], table["ranked"], table["coverage"], table["scale_median"]) == (0, False, None, None)
    assert (table["rank_error"], table["native"]["abs_rel"], table["ci95"]["coverage"]) == (None, None, None)
    read = read_result(empty.to_json(), "x")
    assert read.to_json() == empty.to_json()
    assert (len(read.tables["lattice"].groups), read.views) == (0, [])


def test_keys_of_later_versions_are_ignored_and_intervals_may_be_unstated() -> None:
    document = json.loads(SOUND)
    document["extended"] = {"protocol": "x", "tables": {}}
    document["submission"] |= {"licence": "MIT"}
    document["tables"]["lattice"] |= {"single_bar": {"abs_rel": 0.1}}
    document["tables"]["lattice"]["within_mm"]["50"] = 1.0
    document["tables"]["lattice"]["reference"] |= {"two_pixels": {"abs_rel": 0.057}}
    document["tables"]["lattice"]["ci95"] |= {"single_bar": [0.1, 0.2]}
    document["views"][0] |= {"single_bar": 0.1}
    del document["tables"]["pile"]["ci95"], document["intervals"]
    read = read_result(json.dumps(document).encode(), "x")
    assert json.loads(read.to_json())["tables"]["lattice"] == TABLE
    assert read.intervals is None
    assert "intervals" not in json.loads(read.to_json())


@pytest.mark.parametrize(
    ("content", "location"),
    [
        (b"", "syntax "),
        (b"[]", "invalid "),
        (SOUND.replace(b'"rebar-2"', b'{"a":' * 100 + b"1" + b"}" * 100), "size "),
        (SOUND.replace(b": 43210", b": " + b"9" * 4000), "invalid views 1: scored_px"),
        (SOUND.replace(b": 43210", b": " + b"1e999"), "syntax "),
        (SOUND.replace(b'"method":', b'"method": "a", "method":'), "duplicate "),
        (SOUND.replace(b"my model", b"\\u001b[2J"), "invalid submission.method"),
        (SOUND.replace(b"my model", b"m" * 800_000), "invalid submission.method"),
        (SOUND.replace(b'"rebar-2"', b'"rebar-9"'), "invalid protocol"),
        (SOUND.replace(b'"rebar-2"', b"[" + b"1, " * 200_000 + b"1]"), "invalid protocol"),
    ],
)
def test_malformed_text_is_refused(content: bytes, location: str) -> None:
    assert refused(content) == [location]


def set_at(*path: str | int, value: object) -> Change:
    def change(document: Any) -> None:
        for key in path[:-1]:
            document = document[key]
        document[path[-1]] = value

    return change


def set_groups(groups: object) -> Change:
    return set_at("tables", "lattice", "groups", value=groups)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "location"),
    [
        (set_at("tables", value=[]), "invalid tables"),
        (set_at("tables", "lattice", value=7), "invalid tables.lattice"),
        (set_at("tables", "lattice", "views", value="2"), "invalid tables.lattice.views"),
        (set_at("tables", "lattice", "views", value=True), "invalid tables.lattice.views"),
        (set_at("tables", "lattice", "views_scored", value=-1), "invalid tables.lattice.views_scored"),
        (set_at("tables", "lattice", "coverage", value=1.5), "invalid tables.lattice.coverage"),
        (set_at("views", 0, "coverage", value=None), "invalid views 1: coverage"),
        (set_at("tables", "lattice", "ranked", value="yes"), "invalid tables.lattice.ranked"),
        (set_at("tables", "lattice", "native", value={}), "missing tables.lattice.native.abs_rel"),
        (set_at("tables", "lattice", "native", value=None), "conflict tables.lattice"),
        (set_at("tables", "lattice", "scaled", "delta1", value=2), "invalid tables.lattice.scaled.delta1"),
        (set_at("tables", "lattice", "within_mm", value={"3": 1}), "missing tables.lattice.within_mm.5"),
        (set_at("tables", "lattice", "ci95", "coverage", value=[1]), "invalid tables.lattice.ci95.coverage"),
        (set_at("tables", "lattice", "ci95", "coverage", value=["a", 1]), "invalid tables.lattice.ci95.coverage"),
        (
            set_at("tables", "lattice", "ci95", "coverage", value=[10**400, 1]),
            "invalid tables.lattice.ci95.coverage",
        ),
        (set_at("tables", "lattice", "ci95", "native", value=3), "invalid tables.lattice.ci95.native"),
        (set_at("tables", "a\x1b[2J", value={}), r"invalid tables.'a\x1b[2J'"),
        (set_at("views", value={}), "invalid views"),
        (set_at("views", value=[3] * 200_000), "invalid views 1"),
        (set_at("views", 0, "native", "abs_rel", value="x"), "invalid views 1: native.abs_rel"),
        (set_at("views", 0, "scale", value=-1), "invalid views 1: scale"),
        (set_at("views", 1, "view_id", value="lattice/0000"), "duplicate "),
        (set_at("views", 1, "view_id", value="other/0000"), "conflict "),
        (set_at("views", 1, "view_id", value="a\nb"), "invalid views 2: view_id"),
        (set_at("dataset", "digest", value="/../../../Documents"), "invalid dataset.digest"),
        (set_at("tables", value={str(key): 0 for key in range(20_000)}), "size tables"),
        (
            set_at("tables", "lattice", "within_mm", value={str(key): "x" for key in range(20_000)}),
            "size tables.lattice.within_mm",
        ),
        (set_groups([]), "invalid tables.lattice.groups"),
        (set_groups(None), "invalid tables.lattice.groups"),
        (set_groups({"family": [TABLE]}), "invalid tables.lattice.groups.family"),
        (set_groups({"family": {"wall": None}}), "invalid tables.lattice.groups.family.wall"),
        (
            set_groups({"family": {"wall": TABLE | {"views": -1}}}),
            "invalid tables.lattice.groups.family.wall.views",
        ),
        (set_groups({"family": {"wall": TABLE | {"native": None}}}), "conflict tables.lattice.groups.family.wall"),
        (set_groups({"family": {"a\x1b[2J": TABLE}}), r"invalid tables.lattice.groups.family.'a\x1b[2J'"),
        (set_groups({"a" * 800_000: {}}), f"invalid tables.lattice.groups.'{'a' * 59} ..."),
        (set_groups({"family": {str(key): 0 for key in range(20_000)}}), "size tables"),
        (set_groups({str(key): {str(group): 0 for group in range(100)} for key in range(1000)}), "size tables"),
        (
            set_groups({"family": {"wall": TABLE | {"rank_error": None}}}),
            "conflict tables.lattice.groups.family.wall",
        ),
        (set_at("views", 0, "native", value=None), "conflict views 1"),
    ],
)
def test_wrong_value_is_refused_with_its_place(change: Change, location: str) -> None:
    document = json.loads(SOUND)
    change(document)
    assert location in refused(json.dumps(document).encode())


@pytest.mark.parametrize(
    ("groups", "kept"),
    [
        ({"weather": {"rain": TABLE}}, {"weather": {"rain": TABLE}}),
        ({"family": {"wall": TABLE | {"groups": {"family": {"wall": TABLE}}}}}, {"family": {"wall": TABLE}}),
    ],
)
def test_groups_of_later_versions_are_kept_and_groups_of_groups_are_not(groups: object, kept: object) -> None:
    """Nothing depends on how deep a hostile file nests groups."""
    document = json.loads(SOUND)
    document["tables"]["lattice"]["groups"] = groups
    read = read_result(json.dumps(document).encode(), "x")
    assert json.loads(read.to_json())["tables"]["lattice"]["groups"] == kept


def test_result_beyond_the_limit_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("REBAR_MAX_JSON_BYTES", str(len(SOUND) - 1))
    assert refused(SOUND) == ["size "]
    monkeypatch.setenv("REBAR_MAX_JSON_BYTES", str(len(SOUND)))
    assert read_result(SOUND, "x").method == "my model"


def test_table_of_a_row_is_checked_alike() -> None:
    assert read_table(TABLE) == read_result(SOUND, "x").tables["lattice"]
    with pytest.raises(InputError) as caught:
        read_table(TABLE | {"views": None})
    assert [problem.where for problem in caught.value.problems] == ["views"]
