"""Tests of reading result JSON: what was written is read unchanged, anything malformed is refused."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any

import pytest

from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.scoring.result import read_result
from rebar_depth_bench.scoring.table import read_table
from tests.bench.reporting.results import overflowed_view, result, scored_view, unpredicted_view

VIEWS = [scored_view("lattice/0000"), unpredicted_view("lattice/0001"), overflowed_view("pile/0000")]
SOUND = result(*VIEWS).to_json()

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


def test_keys_of_later_versions_are_ignored() -> None:
    document = json.loads(SOUND)
    document["extended"] = {"protocol": "x", "tables": {}}
    document["submission"] |= {"licence": "MIT"}
    document["tables"]["lattice"] |= {"single_bar": {"abs_rel": 0.1}}
    document["tables"]["lattice"]["within_mm"]["50"] = 1.0
    document["tables"]["lattice"]["reference"] |= {"two_pixels": {"abs_rel": 0.057}}
    document["tables"]["lattice"]["ci95"] |= {"single_bar": [0.1, 0.2]}
    document["views"][0] |= {"single_bar": 0.1}
    del document["tables"]["pile"]["ci95"]
    expected = json.loads(SOUND)["tables"]["lattice"]
    assert json.loads(read_result(json.dumps(document).encode(), "x").to_json())["tables"]["lattice"] == expected


def test_result_that_does_not_state_its_intervals_is_read_without_a_statement() -> None:
    document = json.loads(SOUND)
    del document["intervals"]
    read = read_result(json.dumps(document).encode(), "x")
    assert read.intervals is None
    assert json.loads(read.to_json()) == document


@pytest.mark.parametrize(
    ("content", "location"),
    [
        (b"", "syntax "),
        (b"\xff", "syntax "),
        (b"[]", "invalid "),
        (b"null", "invalid "),
        (b"[" * 100_000, "size "),
        (SOUND.replace(b'"rebar-2"', b'{"a":' * 100 + b"1" + b"}" * 100), "size "),
        (SOUND.replace(b": 43210", b": " + b"9" * 4400), "syntax "),
        (SOUND.replace(b": 43210", b": " + b"9" * 4000), "invalid views 1: scored_px"),
        (SOUND.replace(b": 43210", b": " + b"NaN"), "syntax "),
        (SOUND.replace(b": 43210", b": " + b"1e999"), "syntax "),
        (SOUND.replace(b"my model", b"\\ud800"), "syntax "),
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


@pytest.mark.parametrize(
    ("change", "location"),
    [
        (set_at("tables", value=[]), "invalid tables"),
        (set_at("tables", "lattice", value=7), "invalid tables.lattice"),
        (set_at("tables", "lattice", "views", value="2"), "invalid tables.lattice.views"),
        (set_at("tables", "lattice", "views", value=True), "invalid tables.lattice.views"),
        (set_at("tables", "lattice", "views_scored", value=-1), "invalid tables.lattice.views_scored"),
        (set_at("tables", "lattice", "coverage", value=1.5), "invalid tables.lattice.coverage"),
        (set_at("tables", "lattice", "ranked", value="yes"), "invalid tables.lattice.ranked"),
        (set_at("tables", "lattice", "native", value={}), "missing tables.lattice.native.abs_rel"),
        (set_at("tables", "lattice", "native", value=None), "conflict tables.lattice"),
        (set_at("tables", "lattice", "scaled", "delta1", value=2), "invalid tables.lattice.scaled.delta1"),
        (set_at("tables", "lattice", "within_mm", value={"3": 1}), "invalid tables.lattice.within_mm"),
        (set_at("tables", "lattice", "ci95", "coverage", value=[1]), "missing tables.lattice.ci95.coverage 2"),
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
    ],
)
def test_wrong_value_is_refused_with_its_place(change: Change, location: str) -> None:
    document = json.loads(SOUND)
    change(document)
    assert location in refused(json.dumps(document).encode())


def with_groups(groups: object) -> bytes:
    document = json.loads(SOUND)
    document["tables"]["lattice"]["groups"] = groups
    return json.dumps(document).encode()


TABLE = json.loads(SOUND)["tables"]["lattice"]


@pytest.mark.parametrize(
    ("groups", "location"),
    [
        ([], "invalid tables.lattice.groups"),
        (None, "invalid tables.lattice.groups"),
        ({"family": [TABLE]}, "invalid tables.lattice.groups.family"),
        ({"family": {"wall": None}}, "invalid tables.lattice.groups.family.wall"),
        ({"family": {"wall": TABLE | {"views": -1}}}, "invalid tables.lattice.groups.family.wall.views"),
        ({"family": {"wall": TABLE | {"native": None}}}, "conflict tables.lattice.groups.family.wall"),
        ({"family": {"a\x1b[2J": TABLE}}, r"invalid tables.lattice.groups.family.'a\x1b[2J'"),
        ({"a" * 800_000: {}}, "invalid tables.lattice.groups"),
        ({"family": {str(key): 0 for key in range(20_000)}}, "size tables"),
        ({str(key): {str(group): 0 for group in range(100)} for key in range(1000)}, "size tables"),
        ({"family": {"wall": TABLE | {"rank_error": None}}}, "missing "),
    ],
)
def test_wrong_groups_are_refused_with_their_place(groups: object, location: str) -> None:
    assert any(found.startswith(location) for found in refused(with_groups(groups)))


def test_groups_of_groups_are_ignored() -> None:
    """Nothing depends on how deep a hostile file nests groups."""
    nested: dict[str, Any] = {"family": {"wall": TABLE}}
    read = read_result(with_groups({"family": {"wall": TABLE | {"groups": nested}}}), "x")
    assert read.tables["lattice"].groups["family"]["wall"].groups == {}
    assert read.to_json() == read_result(with_groups({"family": {"wall": TABLE}}), "x").to_json()


def test_groups_of_later_versions_are_kept() -> None:
    read = read_result(with_groups({"weather": {"rain": TABLE}}), "x")
    assert json.loads(read.to_json())["tables"]["lattice"]["groups"] == {"weather": {"rain": TABLE}}


def test_result_beyond_the_limit_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("REBAR_MAX_JSON_BYTES", str(len(SOUND) - 1))
    assert refused(SOUND) == ["size "]
    monkeypatch.setenv("REBAR_MAX_JSON_BYTES", str(len(SOUND)))
    assert read_result(SOUND, "x").method == "my model"


def test_table_of_a_row_is_checked_alike() -> None:
    table = json.loads(SOUND)["tables"]["lattice"]
    assert read_table(table) == read_result(SOUND, "x").tables["lattice"]
    with pytest.raises(InputError) as caught:
        read_table(table | {"views": None})
    assert [problem.where for problem in caught.value.problems] == ["views"]
