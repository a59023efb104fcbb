"""Tests of ``submission.json``: parsing and problems."""

from __future__ import annotations

import json

import pytest

from rebar_depth_bench.submission.metadata import MetadataError, SubmissionMeta, parse_metadata
from tests.bench.submission.conftest import Check
from tests.bench.submission.zips import DEPTH, FIRST, SECOND, Record, deflated, png


def test_optional_and_unknown_keys_are_accepted() -> None:
    assert parse_metadata(b'{"method": "m", "colour": [1]}') == SubmissionMeta("m")
    full = {
        "method": "Größe 2", "description": "d", "url": "http://x.org", "uses_intrinsics": False,
        "depth_scale": 1, "runtime": {"seconds": 1.5},
    }  # fmt: skip
    assert parse_metadata(json.dumps(full).encode()) == SubmissionMeta(
        "Größe 2", "d", "http://x.org", False, 1.0, {"seconds": 1.5}
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "not valid JSON"),
        ("[]", "the JSON is a list, expected an object"),
        ("null", "the JSON is null, expected an object"),
        ('{"method": "m", "x": NaN}', "NaN is not JSON"),
        ('{"method": "m", "x": 1e999}', "not valid JSON"),
        ('{"method": "m", "x": "\\ud800"}', "not valid JSON"),
        ("[" * 100_000, "nested too deep"),
        ("{}", "method is missing, expected a printable name of 1 to 200 characters"),
        ('{"method": 3}', "method is a number, expected"),
        ('{"method": "  "}', "method is '  ', expected"),
        ('{"method": "a\\u0000b"}', r"method is 'a\x00b', expected"),
        ('{"method": "' + "m" * 201 + '"}', "method has 201 characters, expected"),
        ('{"method": "m", "description": 3}', "description is a number, expected text"),
        (
            '{"method": "m", "description": "a\\u0000b"}',
            "description contains a NUL character, expected text without",
        ),
        ('{"method": "m", "url": "javascript:alert(1)"}', "url is javascript:alert(1), expected an address"),
        ('{"method": "m", "url": "http://[::1"}', "url is http://[::1, expected"),
        ('{"method": "m", "url": true}', "url is true or false, expected text"),
        ('{"method": "m", "uses_intrinsics": 1}', "uses_intrinsics is a number, expected true or false"),
        (
            '{"method": "m", "depth_scale": 0}',
            "depth_scale is 0, expected a finite number of metres per unit above 0",
        ),
        ('{"method": "m", "depth_scale": true}', "depth_scale is true or false, expected"),
        ('{"method": "m", "depth_scale": "0.001"}', "depth_scale is text, expected"),
        ('{"method": "m", "depth_scale": 1' + "0" * 400 + "}", "depth_scale is 1000"),
        ('{"method": "m", "x": 1' + "0" * 5000 + "}", "not valid JSON"),
        ('{"method": "m", "runtime": [1]}', "runtime is a list, expected"),
    ],
)
def test_invalid_metadata_is_rejected(check: Check, text: str, words: str) -> None:
    (problem,) = check([Record(b"submission.json", text.encode()), FIRST, SECOND])
    assert problem.startswith("submission.json: ")
    assert words in problem


def test_all_problems_are_reported_at_once() -> None:
    with pytest.raises(MetadataError) as caught:
        parse_metadata(b'{"method": 1, "url": 2, "depth_scale": -1}')
    assert len(caught.value.problems) == 3


def test_non_utf8_and_oversized_metadata_are_rejected(check: Check) -> None:
    (problem,) = check([Record(b"submission.json", b'{"method": "\xff"}'), FIRST, SECOND])
    assert problem == "submission.json: byte 12 is not UTF-8, expected UTF-8 text"
    (problem,) = check([deflated(b"submission.json", bytes(5_000_000)), FIRST, SECOND])
    assert problem == "submission.json: the declared size is 5000000 bytes, expected at most 4194304"


def test_png_without_depth_scale_is_one_problem(check: Check) -> None:
    units = (DEPTH * 1000).astype("u2")
    views = [Record(f"lattice/000{index}.png".encode(), png(units)) for index in range(2)]
    assert check([Record(b"submission.json", b'{"method": "m"}'), *views]) == [
        "submission.json: depth_scale is missing, expected metres per PNG unit, "
        "because 2 entries are PNG (first lattice/0000.png)"
    ]
