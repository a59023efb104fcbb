"""Tests of ``submission.json``: parsing and problems."""

from __future__ import annotations

import json
from typing import Any

import pytest

from rebar_depth_bench.base.errors import ProblemCode
from rebar_depth_bench.submission.declaration import SubmissionMeta, parse_metadata
from tests.bench.submission.conftest import Check, located
from tests.bench.submission.zips import DEPTH, FIRST, SECOND, Record, deflated, png


def test_optional_and_unknown_keys_are_accepted() -> None:
    for text in (b'{"method": "m", "colour": [1]}', b'{"method": "m", "url": null, "depth_scale": null}'):
        assert parse_metadata(text) == (SubmissionMeta(method="m"), [])
    full: dict[str, Any] = {
        "method": "Größe 2", "description": "d", "url": "http://x.org",
        "inputs": "rgb+K", "uses_ground_truth": False, "depth_scale": 1, "runtime": {"seconds": 1.5},
    }  # fmt: skip
    assert parse_metadata(json.dumps(full).encode()) == (SubmissionMeta(**full), [])


@pytest.mark.parametrize("runtime", ["3", "1.5", '"fast"', '{"seconds": [1, null]}', "1" + "0" * 400])
def test_runtime_is_kept_unchanged(runtime: str) -> None:
    meta, _ = parse_metadata(f'{{"method": "m", "runtime": {runtime}}}'.encode())
    assert meta is not None
    assert json.dumps(meta.runtime) == runtime


@pytest.mark.parametrize(
    ("text", "code", "key"),
    [
        ("", "syntax", ""),
        ("[]", "invalid", ""),
        ("null", "invalid", ""),
        ('{"method": "m", "x": NaN}', "syntax", ""),
        ('{"method": "m", "x": 1e999}', "syntax", ""),
        ('{"method": "m", "x": "\\ud800"}', "syntax", ""),
        ("[" * 100_000, "size", ""),
        ('{"method": "m", "runtime": {"a": 1, "a": 2}}', "duplicate", ""),
        ('{"method": "m", "method": "n"}', "duplicate", ""),
        ("{}", "missing", ": method"),
        ('{"method": null}', "missing", ": method"),
        ('{"method": 3}', "invalid", ": method"),
        ('{"method": "  "}', "invalid", ": method"),
        ('{"method": "a\\u0000b"}', "invalid", ": method"),
        ('{"method": "' + "m" * 201 + '"}', "invalid", ": method"),
        ('{"method": "m", "description": 3}', "invalid", ": description"),
        ('{"method": "m", "description": "a\\u0000b"}', "invalid", ": description"),
        ('{"method": "m", "url": "javascript:alert(1)"}', "invalid", ": url"),
        ('{"method": "m", "url": "http://[::1"}', "invalid", ": url"),
        ('{"method": "m", "url": true}', "invalid", ": url"),
        ('{"method": "m", "inputs": "sonar"}', "invalid", ": inputs"),
        ('{"method": "m", "inputs": ["rgb"]}', "invalid", ": inputs"),
        ('{"method": "m", "uses_ground_truth": "no"}', "invalid", ": uses_ground_truth"),
        ('{"method": "m", "depth_scale": 0}', "invalid", ": depth_scale"),
        ('{"method": "m", "depth_scale": true}', "invalid", ": depth_scale"),
        ('{"method": "m", "depth_scale": "0.001"}', "invalid", ": depth_scale"),
        ('{"method": "m", "depth_scale": 1' + "0" * 400 + "}", "invalid", ": depth_scale"),
        ('{"method": "m", "x": 1' + "0" * 5000 + "}", "syntax", ""),
        ('{"method": "m", "runtime": [1]}', "invalid", ": runtime"),
        ('{"method": "m", "runtime": true}', "invalid", ": runtime"),
    ],
)
def test_invalid_metadata_is_rejected(check: Check, text: str, code: ProblemCode, key: str) -> None:
    (problem,) = check([Record(b"submission.json", text.encode()), FIRST, SECOND])
    assert (problem.code, problem.where) == (code, f"submission.json{key}")
    assert str(problem).isprintable()


def test_constant_that_is_not_json_is_named() -> None:
    (problem,) = parse_metadata(b'{"method": "m", "x": -Infinity}')[1]
    assert "-Infinity is not JSON" in problem.found


def test_all_problems_are_reported_at_once() -> None:
    meta, problems = parse_metadata(b'{"method": 1, "url": 2, "depth_scale": -1}')
    assert meta is None
    assert sorted(problem.where for problem in problems) == [
        f"submission.json: {key}" for key in ("depth_scale", "method", "url")
    ]


def test_non_utf8_and_oversized_metadata_are_rejected(check: Check) -> None:
    problems = check([Record(b"submission.json", b'{"method": "\xff"}'), FIRST, SECOND])
    assert located(problems) == [("syntax", "submission.json")]
    problems = check([deflated(b"submission.json", bytes(5_000_000)), FIRST, SECOND])
    assert located(problems) == [("size", "submission.json")]
    assert located(parse_metadata(bytes(5_000_000))[1]) == [("size", "submission.json")]


def test_png_without_depth_scale_is_one_problem(check: Check) -> None:
    units = (DEPTH * 1000).astype("u2")
    views = [Record(f"lattice/000{index}.png".encode(), png(units)) for index in range(2)]
    (problem,) = check([Record(b"submission.json", b'{"method": "m"}'), *views])
    assert (problem.code, problem.where) == ("missing", "submission.json: depth_scale")
    assert "2 entries are PNG (first lattice/0000.png)" in problem.expected
