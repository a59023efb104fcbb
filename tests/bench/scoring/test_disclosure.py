"""Disclosed part of results: what it contains, how it is rounded, and which archives are refused."""

from __future__ import annotations

import json

import pytest

from rebar_depth_bench.base.errors import InputError, SubmissionError
from rebar_depth_bench.scoring.result import check_view_coverage, disclosed_json, is_disclosed, read_disclosed
from tests.bench.reporting.results import result, scored_view

RESULT = result(scored_view("lattice/0000", 0.12345), scored_view("pile/0000", 0.5, coverage=0.98765))


def test_disclosed_result_has_rank_error_and_coverage_alone() -> None:
    whole = RESULT.to_dict()
    disclosed = json.loads(disclosed_json(RESULT.to_json()))
    assert is_disclosed(disclosed)
    assert not is_disclosed(whole)
    assert disclosed.pop("hidden_truth") is True
    tables = disclosed.pop("tables")
    assert disclosed == {key: whole[key] for key in ("protocol", "dataset", "submission", "software")}
    for config, table in whole["tables"].items():
        assert tables[config] == {
            "coverage": round(table["coverage"], 3),
            "ranked": True,
            "rank_error": round(table["rank_error"], 3),
        }


def test_new_numbers_of_results_are_not_disclosed() -> None:
    document = RESULT.to_dict()
    for part in (document, document["dataset"], document["submission"], document["tables"]["lattice"]):
        part["new"] = 0.123456
    assert disclosed_json(json.dumps(document).encode()) == disclosed_json(RESULT.to_json())


def test_disclosed_result_is_read_and_disclosed_again_unchanged() -> None:
    data = disclosed_json(RESULT.to_json())
    content = read_disclosed(data, "r.json")
    assert (content.submission.method, content.submission.sha256) == (RESULT.method, RESULT.submission.sha256)
    assert disclosed_json(data) == data


@pytest.mark.parametrize(
    "data",
    [
        b'{"protocol": "rebar-9"}',
        b"[]",
        json.dumps({**RESULT.to_dict(), "protocol": "rebar-1"}).encode(),
        b'{"protocol": "rebar-9", "tables": {"lattice": {"rank_error": 0.5}}}',
    ],
)
def test_unreadable_result_has_no_numbers(data: bytes) -> None:
    assert json.loads(disclosed_json(data)) == {"hidden_truth": True}
    with pytest.raises(InputError):
        read_disclosed(disclosed_json(data), "r.json")


def test_view_below_half_coverage_is_refused_without_its_name() -> None:
    check_view_coverage([scored_view("lattice/0000", coverage=0.5)])
    with pytest.raises(SubmissionError) as refusal:
        check_view_coverage([scored_view("lattice/0000"), scored_view("lattice/0001", coverage=0.4999)])
    assert "lattice" not in str(refusal.value)
    assert "0.4999" not in str(refusal.value)
    assert [(problem.code, problem.where) for problem in refusal.value.problems] == [("missing", "")]
