"""Tests of archive validation and of the submission reader."""

from __future__ import annotations

import mmap
import os
import stat
import struct
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rebar_depth_bench.errors import SubmissionError
from rebar_depth_bench.submission import EntryError, check_archive, open_submission
from tests.bench.submission.conftest import Check
from tests.bench.submission.zips import (
    DEPTH,
    EXPECTED,
    FIRST,
    GOOD,
    META,
    SECOND,
    Record,
    build,
    deflated,
    npy,
    npz,
    with_first,
)

ENTRY = "lattice/0000.npy"


def test_valid_archives_have_no_problems(check: Check) -> None:
    assert check(GOOD) == []
    assert check(build(GOOD, comment=b"made by hand PK\5\6")) == []
    assert check([Record(b"lattice/", mode=0o40755), *GOOD]) == []
    assert check([META, Record(b"pile/0000.npz", npz(z=np.ones((2, 5))))]) == []
    assert (
        check([META, deflated(b"lattice/0000.npy", npy(DEPTH)), deflated(b"lattice/0001.npy", npy(DEPTH), 0)])
        == []
    )
    streamed = replace(FIRST, flags=8, local_size=0)
    assert check([META, streamed, SECOND]) == []


def test_zip64_sizes_in_directory_and_local_header(check: Check) -> None:
    size = len(FIRST.data)
    wide = struct.pack("<2H2Q", 1, 16, size, size)
    full = {"size": 0xFFFFFFFF, "compressed": 0xFFFFFFFF, "local_size": 0xFFFFFFFF}
    assert check(with_first(**full, extra=wide, local_extra=wide)) == []
    (problem,) = check(with_first(**full))
    assert problem == "the zip directory record of entry 1 lacks its zip64 sizes, expected 2"


INVALID_ENTRIES = [
    (with_first(flags=1), "the entry is encrypted, expected plain data"),
    (with_first(mode=stat.S_IFLNK | 0o777), "the entry is a symbolic link, expected a regular file"),
    (with_first(mode=stat.S_IFCHR), "the entry is a character device, expected a regular file"),
    (with_first(mode=stat.S_IFDIR), "the entry is a directory, expected a regular file"),
    (with_first(method=12), "the compression method is 12, expected 0 (stored) or 8 (deflated)"),
    (with_first(size=640 * 10**6), "the declared size is 640000000 bytes, expected at most 4192"),
    (with_first(size=10), f"{len(FIRST.data)} bytes are stored, expected the declared 10"),
    (
        with_first(local_name=b"lattice/0001.npy"),
        "the name in the local header is b'lattice/0001.npy', expected",
    ),
    (
        with_first(local_method=8),
        "the compression method in the local header is 8, expected the directory's 0",
    ),
    (
        with_first(local_size=9),
        f"the size in the local header is 9, expected the directory's {len(FIRST.data)}",
    ),
    (with_first(crc=7), "the data is corrupt: its checksum is"),
    (with_first(offset=7), "no local header was found at byte 7, expected one"),
    (with_first(offset=10**6), "the data is declared at byte 1000000, expected it before the directory"),
    (with_first(compressed=4000), "expected it before the directory at"),
    (with_first(disk=1), "the entry is on disk 1 of a multi-disk set"),
    (with_first(method=8, data=b"\xff" * 9), "the deflated data is corrupt (Error -3"),
]


@pytest.mark.parametrize(("records", "words"), INVALID_ENTRIES, ids=[words[:30] for _, words in INVALID_ENTRIES])
def test_invalid_entry_is_named_in_problem(check: Check, records: list[Record], words: str) -> None:
    problems = check(records)
    assert any(problem.startswith(f"{ENTRY}: ") and words in problem for problem in problems), problems


@pytest.mark.parametrize(
    "name",
    [
        b"/etc/passwd",
        b"../lattice/0000.npy",
        b"lattice/../../x.npy",
        b"lattice\\0000.npy",
        b"C:/x.npy",
        b"C:x.npy",
    ],
)
def test_escaping_names_are_rejected(check: Check, name: bytes) -> None:
    (problem,) = check([*GOOD, Record(name, b"x")])
    assert problem.startswith(f"{name.decode()}: the name escapes the archive, expected a relative path")


@pytest.mark.parametrize("name", [b"pile/0000.npy\0.txt", b"pile/0000.npy\n", b"\x1b[31mred.npy"])
def test_control_characters_are_rejected_and_not_echoed(check: Check, name: bytes) -> None:
    (problem,) = check([*GOOD, Record(name, npy(np.ones((2, 5))))])
    assert "the name has a control character, expected plain text" in problem
    assert problem.isprintable()


def test_duplicate_names_views_and_metadata_are_reported(check: Check) -> None:
    twin = Record(b"lattice/0001.npz", npz(z=DEPTH))
    assert check([META, FIRST, FIRST, SECOND]) == [
        f"lattice/0000: 2 entries were found ({ENTRY}, {ENTRY}), expected one"
    ]
    assert check([META, META, FIRST, SECOND, twin]) == [
        "submission.json: 2 entries were found (submission.json, submission.json), expected one",
        "lattice/0001: 2 entries were found (lattice/0001.npy, lattice/0001.npz), expected one",
    ]


def test_records_with_the_same_data_overlap(check: Check) -> None:
    start = 30 + len(META.name) + len(META.data)
    problems = check([META, FIRST, replace(SECOND, offset=start)])
    assert (
        f"lattice/0001.npy: the data from byte {start} overlaps that of {ENTRY}, expected separate data"
        in problems
    )


def test_entry_inside_data_of_another_overlaps(check: Check) -> None:
    """Check a local header inside a stored entry: names and checksums agree, only the byte ranges overlap."""
    inner = npy(DEPTH)
    quoted = build([Record(b"lattice/0001.npy", inner)])
    body = quoted[: 30 + 16 + len(inner)]
    outer = Record(b"lattice/0000.npy", body)
    at = 30 + len(META.name) + len(META.data) + 30 + len(outer.name)
    (overlap, other) = check([META, outer, replace(SECOND, offset=at)])
    assert overlap == f"lattice/0001.npy: the data from byte {at} overlaps that of {ENTRY}, expected separate data"
    assert other.startswith(f"{ENTRY}: bytes that start with b'PK")


def test_unknown_entries_are_explained(check: Check) -> None:
    unknown_names = [
        b"lattice/0002.npy",
        b"LATTICE/0000.npy",
        b"lattice/0000.tiff",
        b"readme.txt",
        b"lattice/0000.NPY",
    ]
    assert check([*GOOD, *(Record(name) for name in unknown_names)]) == [
        "lattice/0002.npy: unknown entry, the dataset has no view lattice/0002 in the config lattice",
        "LATTICE/0000.npy: unknown entry, the dataset has no config LATTICE, expected one of lattice, pile",
        "lattice/0000.tiff: unknown entry, the suffix is .tiff, expected one of .npy, .npz, .exr, .png",
        "readme.txt: unknown entry, expected submission.json or <view_id> with one of .npy, .npz, .exr, .png",
        "lattice/0000.NPY: unknown entry, the suffix is .NPY, expected one of .npy, .npz, .exr, .png",
    ]


def test_macos_entries_are_one_problem_with_a_remedy(check: Check) -> None:
    junk = [Record(b"__MACOSX/lattice/._0000.npy", b"x"), Record(b"lattice/.DS_Store", b"x")]
    (problem,) = check([*GOOD, *junk])
    assert problem.startswith(
        "__MACOSX/lattice/._0000.npy: 2 entries made by macOS were found, expected none; zip with:"
    )


def test_enclosing_folder_is_one_problem(check: Check) -> None:
    wrapped = [replace(record, name=b"sub/" + record.name) for record in GOOD]
    assert check([Record(b"sub/", mode=0o40755), *wrapped]) == [
        "sub/submission.json: all 3 entries are inside the folder sub/, expected submission.json at the top "
        "level: zip the folder's contents, not the folder"
    ]


def test_missing_views_and_metadata_are_reported(check: Check) -> None:
    (problem,) = check([META, FIRST])
    assert problem.startswith("lattice/0001: missing, expected one of .npy, .npz, .exr, .png, because other views")
    assert check([FIRST, SECOND]) == ['submission.json: missing, expected {"method": "name"}']
    (problem,) = check([META])
    assert problem.startswith("no view was found, expected <view_id>")
    assert len(check([])) == 2


def test_all_problems_are_reported_in_fixed_order(check: Check) -> None:
    bad = [
        replace(FIRST, flags=1),
        Record(b"lattice/0001.npy", npy(DEPTH.T)),
        Record(b"x"),
        Record(b"submission.json", b"{}"),
    ]
    problems = check(bad)
    assert [problem.split(":")[0] for problem in problems] == [
        ENTRY,
        "x",
        "submission.json",
        "lattice/0001.npy",
    ]
    assert check(bad) == problems


def test_error_shows_20_problems_and_count_of_the_rest(tmp_path: Path) -> None:
    expected = {f"lattice/{index:04d}": (3, 4) for index in range(31)}
    (tmp_path / "s.zip").write_bytes(build([META, FIRST]))
    problems = check_archive(tmp_path / "s.zip", expected)
    assert len(problems) == 30
    text = str(SubmissionError("s.zip", problems))
    assert text.count("\n  - ") == 20
    assert text.endswith("... and 10 more")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "the file is empty (0 bytes), expected a zip archive"),
        (b"x" * 100, "the file is not a zip"),
        (build(GOOD)[:-40], "the zip has no end record, expected one at the end: the file is truncated"),
        (b"#!/bin/sh\n" + build(GOOD), "has bytes before the archive"),
        (build(GOOD) + b"x", "the zip has no end record"),
        (build(GOOD, count=2), "the zip directory holds 2 entries"),
        (build(GOOD, count=4), "the zip directory holds 3 entries"),
        (
            build(GOOD, disk=1),
            "part of a multi-disk set (disk 1, 3 of 3 entries), expected a single complete file",
        ),
        (build(GOOD, count=60_000), "declares 60000 entries in"),
    ],
)
def test_file_that_is_no_zip_is_one_problem(check: Check, content: bytes, words: str) -> None:
    (problem,) = check(content)
    assert words in problem


def test_path_that_is_no_file_is_one_problem(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    assert check_archive(tmp_path / "a.zip", EXPECTED) == [
        "the file cannot be read: it does not exist, expected a zip archive"
    ]
    assert check_archive(tmp_path, EXPECTED) == ["the path is a directory, expected a zip archive"]
    assert check_archive(tmp_path / "pipe", EXPECTED) == ["the path is not a regular file, expected a zip archive"]
    (problem,) = check_archive("a\0b", EXPECTED)
    assert "cannot be read" in problem


def test_reader_in_threads_and_after_closing(tmp_path: Path) -> None:
    path = tmp_path / "s.zip"
    path.write_bytes(build(GOOD))
    with open_submission(path, EXPECTED) as reader, ThreadPoolExecutor(4) as pool:
        assert reader.meta is not None
        for array in pool.map(reader.read, reader.view_ids * 50):
            np.testing.assert_array_equal(array, DEPTH)
        with pytest.raises(EntryError, match="pile/0000: no valid entry was found"):
            reader.read("pile/0000")
    with pytest.raises(ValueError, match="is closed"):
        reader.read("lattice/0000")


def test_stored_view_is_memory_mapped_and_outlives_reader(tmp_path: Path) -> None:
    shape = (200, 300)
    values = np.random.default_rng(0).random(shape, dtype=np.float32)
    name = b"lattice/0000.npy"
    aligned = -(30 + len(name)) % 4
    path = tmp_path / "s.zip"
    path.write_bytes(build([Record(name, npy(values), local_extra=bytes(aligned)), META]))
    with open_submission(path, {"lattice/0000": shape}) as reader:
        array = reader.read("lattice/0000")
    base: object = array
    while isinstance(base, np.ndarray):
        base = base.base
    assert isinstance(base, memoryview)
    assert isinstance(base.obj, mmap.mmap)
    assert not array.flags.writeable
    np.testing.assert_array_equal(array, values)


def test_unaligned_values_are_returned_aligned(tmp_path: Path) -> None:
    path = tmp_path / "s.zip"
    shape = (200, 300)
    for pad in range(4):
        path.write_bytes(build([META, replace(FIRST, data=npy(np.ones(shape)), local_extra=bytes(pad))]))
        with open_submission(path, {"lattice/0000": shape}) as reader:
            assert reader.read("lattice/0000").flags.aligned


def test_file_truncated_while_open_raises_entry_error(tmp_path: Path) -> None:
    path = tmp_path / "s.zip"
    path.write_bytes(build(GOOD))
    with open_submission(path, EXPECTED) as reader:
        os.truncate(path, 100)
        with pytest.raises(EntryError, match=f"{ENTRY}: the archive was truncated while it was read"):
            reader.read("lattice/0000")


def test_dropped_reader_closes_its_file(tmp_path: Path) -> None:
    path = tmp_path / "s.zip"
    path.write_bytes(build(GOOD))
    before = len(list(Path("/proc/self/fd").iterdir()))
    for _ in range(5):
        assert open_submission(path, EXPECTED).view_ids
    assert len(list(Path("/proc/self/fd").iterdir())) == before
