"""``SubmissionWriter`` and ``submission.json``: what is written, read and refused."""

from __future__ import annotations

import itertools
import json
import os
import struct
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rebar_depth_bench.base.errors import InputError, ProblemCode
from rebar_depth_bench.submission import SubmissionReader, SubmissionWriter
from rebar_depth_bench.submission.declaration import SubmissionMeta, parse_metadata
from tests.bench.submission.zips import (
    DEPTH,
    EXPECTED,
    FIRST,
    SECOND,
    SHAPE,
    Array,
    Record,
    check_archive,
    deflated,
    located,
    png,
    problems_of,
)


def write(path: Path, **options: object) -> None:
    with SubmissionWriter(path, "my model", **options) as writer:  # type: ignore[arg-type]
        writer.add("lattice/0000", DEPTH, seconds=0.25)
        writer.add("lattice/0001", DEPTH[::-1].astype(np.float16))


@pytest.mark.parametrize("compress", [False, True])
def test_written_archive_reads_back(tmp_path: Path, compress: bool) -> None:
    path = tmp_path / "s.zip"
    about: dict[str, Any] = {"description": "d", "url": "https://x.org/a"}
    write(path, compress=compress, **about, runtime={"gpu": "none"})
    assert check_archive(path, EXPECTED) == []
    with SubmissionReader(path, EXPECTED) as reader:
        assert reader.view_ids == ("lattice/0000", "lattice/0001")
        np.testing.assert_array_equal(reader.read("lattice/0000"), DEPTH)
        half = reader.read("lattice/0001")
        assert half.dtype == np.float16
        np.testing.assert_array_equal(half, DEPTH[::-1].astype(np.float16))
        runtime = {"gpu": "none", "seconds": {"lattice/0000": 0.25}}
        assert reader.meta == SubmissionMeta(method="my model", **about, runtime=runtime)
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None
        assert [info.external_attr >> 16 for info in archive.infolist()] == [0o100644] * 3
        with archive.open("lattice/0000.npy") as entry:
            np.testing.assert_array_equal(np.load(entry), DEPTH)
    if not compress:
        assert path.read_bytes().index(DEPTH.tobytes()) % 64 == 0, "stored values are aligned"


@pytest.mark.parametrize("compress", [False, True])
def test_same_predictions_give_identical_bytes(
    tmp_path: Path, compress: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path / "a.zip", compress=compress)
    monkeypatch.setattr(time, "time", lambda: 2e9)
    previous = os.umask(0o077)
    try:
        write(tmp_path / "b.zip", compress=compress)
    finally:
        os.umask(previous)
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()


def test_views_of_several_threads_are_all_in_the_archive(tmp_path: Path) -> None:
    depths = {f"lattice/{index:04d}": np.full((60, 80), 1 + index, np.float32) for index in range(64)}
    with (
        SubmissionWriter(tmp_path / "a.zip", "m", compress=True) as writer,
        ThreadPoolExecutor(8) as threads,
    ):
        list(threads.map(writer.add, depths, depths.values(), itertools.count()))
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        assert sorted(archive.namelist()) == [*(f"{view_id}.npy" for view_id in depths), "submission.json"]
        for view_id, depth_m in depths.items():
            with archive.open(f"{view_id}.npy") as entry:
                assert np.array_equal(np.load(entry), depth_m)
        seconds = json.loads(archive.read("submission.json"))["runtime"]["seconds"]
    assert seconds == {view_id: float(index) for index, view_id in enumerate(depths)}


def test_archive_appears_on_exit_alone_and_replaces_none_after_an_exception(tmp_path: Path) -> None:
    path = tmp_path / "s.zip"
    with SubmissionWriter(path, "m") as writer:
        writer.add("lattice/0000", DEPTH)
        assert not path.exists()
    before = path.read_bytes()
    with pytest.raises(ZeroDivisionError), SubmissionWriter(path, "other") as writer:
        writer.add("lattice/0000", DEPTH, seconds=1 / 0)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


class Tensor:
    def __array__(self, dtype: object = None, copy: object = None) -> Array:
        return np.asfortranarray(DEPTH.astype(">f4"))


def test_invalid_values_lists_and_array_interfaces_are_written(tmp_path: Path) -> None:
    values = np.array([[np.nan, np.inf, -np.inf, 0.0], [-1.0, 1e300, 1e-300, 2.0], [1, 2, 3, 4]])
    with SubmissionWriter(tmp_path / "s.zip", "m") as writer:
        writer.add("lattice/0000", values.tolist())
        writer.add("lattice/0001", Tensor())
    with SubmissionReader(tmp_path / "s.zip", EXPECTED) as reader:
        with np.errstate(over="ignore", under="ignore"):
            np.testing.assert_array_equal(reader.read("lattice/0000"), values.astype(np.float32))
        np.testing.assert_array_equal(reader.read("lattice/0001"), DEPTH)


class GpuTensor:
    def __array__(self, dtype: object = None, copy: object = None) -> Array:
        raise TypeError("can't convert cuda:0 device type tensor to numpy")


@pytest.mark.parametrize(
    ("view_id", "depth", "words"),
    [
        ("lattice/0000", DEPTH, "lattice/0000: the view was added twice, expected once"),
        ("0001", DEPTH, "view_id is 0001, expected '<config>/<number>'"),
        ("../x", DEPTH, r"view_id is ../x, expected"),
        ("lattice/0001\n", DEPTH, r"view_id is 'lattice/0001\\n', expected"),
        (7, DEPTH, "view_id is 7, expected"),
        ("lattice/0001", np.ones((2, 3, 4)), r"0001: depth is float64 of shape \(2, 3, 4\), expected an array"),
        ("lattice/0001", np.zeros((0, 4)), r"shape \(0, 4\), expected an array of floats of shape \(H, W\)"),
        ("lattice/0001", np.ones(SHAPE, np.uint16), "depth is uint16 of shape"),
        ("lattice/0001", np.ones(SHAPE, bool), "depth is bool of shape"),
        ("lattice/0001", np.ones(SHAPE, complex), "depth is complex128 of shape"),
        ("lattice/0001", np.zeros(SHAPE).view(np.ma.MaskedArray), "masked array, expected NaN"),
        ("lattice/0001", GpuTensor(), "cannot be converted to a numpy array .*cuda:0"),
        ("lattice/0001", [[1.0], [1.0, 2.0]], "cannot be converted to a numpy array"),
    ],
)
def test_add_rejects_invalid_view_id_and_depth(tmp_path: Path, view_id: str, depth: object, words: str) -> None:
    with SubmissionWriter(tmp_path / "s.zip", "m") as writer:
        writer.add("lattice/0000", DEPTH)
        with pytest.raises(InputError, match=words):
            writer.add(view_id, depth)
        writer.add("lattice/0001", DEPTH)
    assert check_archive(tmp_path / "s.zip", EXPECTED) == []


def test_add_requires_open_writer_and_valid_seconds(tmp_path: Path) -> None:
    writer = SubmissionWriter(tmp_path / "s.zip", "m")
    with pytest.raises(InputError, match="not open, expected add"):
        writer.add("lattice/0000", DEPTH)
    with writer:
        for seconds, found in ((float("nan"), "nan"), (1e19, "1e\\+19"), (10**5000, "a huge int")):
            with pytest.raises(InputError, match=f"seconds is {found}, expected a number from 0 to 1e\\+18"):
                writer.add("lattice/0000", DEPTH, seconds=seconds)
    with pytest.raises(InputError, match="not open"):
        writer.add("lattice/0000", DEPTH)


CYCLE: list[object] = []
CYCLE.append(CYCLE)


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"method": " "}, "submission.json: method"),
        ({"method": "m", "url": "ftp://x"}, "submission.json: url"),
        ({"method": "m", "parameters": 10**400}, "submission.json: parameters"),
        ({"method": "m", "runtime": {"s": (1, 10**400)}}, "submission.json: runtime"),
        ({"method": "m", "runtime": {"s": 10**5000}}, ""),
        ({"method": "m", "runtime": {"s": float("nan")}}, ""),
        ({"method": "m", "runtime": {"s": object()}}, ""),
        ({"method": "m", "runtime": {"s": CYCLE}}, ""),
        ({"method": "m", "runtime": {1: "s", "s": 1}}, ""),
    ],
)
def test_invalid_metadata_raises_on_construction(tmp_path: Path, options: dict[str, object], key: str) -> None:
    with pytest.raises(InputError) as caught:
        SubmissionWriter(tmp_path / "s.zip", **options)  # type: ignore[arg-type]
    assert located(caught.value.problems) == [("invalid", key)]


def test_unwritable_target_raises_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"), SubmissionWriter(tmp_path / "a" / "s.zip", "m"):
        pass
    with pytest.raises(InputError, match="is a directory"), SubmissionWriter(tmp_path, "m"):
        pass


def test_archive_past_zip64_limit_reads_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # A low limit replaces that of 4 GB, so that an archive of some kilobytes has the same zip64 fields.
    monkeypatch.setattr(zipfile, "ZIP64_LIMIT", 1000)
    path = tmp_path / "s.zip"
    views = {f"lattice/{index:04d}": (16, 16) for index in range(4)}
    with SubmissionWriter(path, "m") as writer:
        for view_id in views:
            writer.add(view_id, np.ones((16, 16)))
    content = path.read_bytes()
    assert b"PK\x06\x06" in content
    assert struct.pack("<L", 0xFFFFFFFF) in content
    assert check_archive(path, views) == []


def test_optional_and_unknown_keys_are_accepted() -> None:
    for text in (b'{"method": "m", "colour": [1]}', b'{"method": "m", "url": null, "depth_scale": null}'):
        assert parse_metadata(text) == (SubmissionMeta(method="m"), [])
    full: dict[str, Any] = {"method": "Größe 2", "description": "d", "url": "http://x.org", "inputs": "rgb+K"}
    full |= {"uses_ground_truth": False, "depth_scale": 1, "runtime": {"seconds": 1.5}}
    assert parse_metadata(json.dumps(full).encode()) == (SubmissionMeta(**full), [])


@pytest.mark.parametrize("runtime", ["3", "1.5", '"fast"', '{"seconds": [1, null]}', "1" + "0" * 18])
def test_runtime_is_kept_unchanged(runtime: str) -> None:
    meta, _ = parse_metadata(f'{{"method": "m", "runtime": {runtime}}}'.encode())
    assert meta is not None
    assert json.dumps(meta.runtime) == runtime


@pytest.mark.parametrize(
    ("text", "code", "key"),
    [
        ("", "syntax", ""),
        ("[]", "invalid", ""),
        ('{"method": "m", "runtime": {"a": 1, "a": 2}}', "duplicate", ""),
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
        ('{"method": "' + "\\ufdfa" * 12 + '"}', "invalid", ": method"),
        ('{"method": "m", "description": "' + "d" * 4001 + '"}', "invalid", ": description"),
        ('{"method": "m", "runtime": [1]}', "invalid", ": runtime"),
        ('{"method": "m", "runtime": true}', "invalid", ": runtime"),
    ],
)
def test_invalid_metadata_is_rejected(text: str, code: ProblemCode, key: str) -> None:
    (problem,) = problems_of([Record(b"submission.json", text.encode()), FIRST, SECOND])
    assert (problem.code, problem.where) == (code, f"submission.json{key}")
    assert str(problem).isprintable()


@pytest.mark.parametrize("number", ["1e19", "-1e19", "1" + "0" * 17 + "01", "1" + "0" * 309, "-1" + "0" * 4298])
@pytest.mark.parametrize(
    ("key", "value"),
    [("depth_scale", "%s"), ("parameters", "%s"), ("runtime", "%s"), ("runtime", '{"a": [1, {"b": [%s]}]}')],
)
def test_number_above_the_limit_is_a_problem_of_its_key(key: str, value: str, number: str) -> None:
    meta, [problem] = parse_metadata(f'{{"method": "m", "{key}": {value % number}}}'.encode())
    assert meta is None
    assert problem.where == f"submission.json: {key}"
    assert problem.code == "invalid"
    assert "1e+18" in problem.expected
    assert len(str(problem)) < 200


def test_values_at_their_limits_are_accepted() -> None:
    largest = 10**18
    values = {"depth_scale": largest, "parameters": largest, "runtime": {"seconds": [-largest, 1e18]}}
    # The form NFKC of U+FDFA has 18 characters.
    texts = {"method": "\ufdfa" * 11 + "xy", "description": "d" * 4000}
    meta, problems = parse_metadata(json.dumps({**texts, **values, "unused": 10**400}).encode())
    assert problems == []
    assert meta == SubmissionMeta(**texts, **values)  # type: ignore[arg-type]


def test_oversized_metadata_and_all_problems_are_reported_at_once() -> None:
    problems = problems_of([deflated(b"submission.json", bytes(5_000_000)), FIRST, SECOND])
    assert located(problems) == located(parse_metadata(bytes(5_000_000))[1]) == [("size", "submission.json")]
    meta, problems = parse_metadata(b'{"method": 1, "url": 2, "depth_scale": -1}')
    assert meta is None
    keys = ("depth_scale", "method", "url")
    assert sorted(problem.where for problem in problems) == [f"submission.json: {key}" for key in keys]


def test_png_without_depth_scale_is_one_problem() -> None:
    units = (DEPTH * 1000).astype("u2")
    views = [Record(f"lattice/000{index}.png".encode(), png(units)) for index in range(2)]
    (problem,) = problems_of([Record(b"submission.json", b'{"method": "m"}'), *views])
    assert (problem.code, problem.where) == ("missing", "submission.json: depth_scale")
    assert "2 entries are PNG (first lattice/0000.png)" in problem.expected
