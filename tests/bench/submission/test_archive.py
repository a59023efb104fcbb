"""Archives of submissions: validation, false sizes within little memory, and the reader."""

from __future__ import annotations

import os
import stat
import struct
import tracemalloc
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rebar_depth_bench.base.errors import Problem, ProblemCode
from rebar_depth_bench.submission import EntryError, SubmissionReader
from tests.bench.submission.zips import (
    DEPTH,
    EXPECTED,
    FIRST,
    GOOD,
    META,
    SECOND,
    Record,
    build,
    check_archive,
    deflated,
    located,
    npy,
    npy_header,
    npz,
    problems_of,
    with_first,
)

ENTRY = "lattice/0000.npy"
PACKED = deflated(b"lattice/0000.npy", npy(DEPTH))
SUFFIXES = "one of .npy, .npz, .exr, .png"


def test_valid_archives_have_no_problems() -> None:
    assert problems_of(GOOD) == []
    assert problems_of(build(GOOD, comment=b"made by hand PK\5\6")) == []
    assert problems_of([Record(b"lattice/", mode=0o40755), *GOOD]) == []
    assert problems_of([META, Record(b"pile/0000.npz", npz(z=np.ones((2, 5))))]) == []
    assert problems_of([META, PACKED, deflated(b"lattice/0001.npy", npy(DEPTH), 0)]) == []
    streamed = replace(FIRST, flags=8, local_size=0)
    assert problems_of([META, streamed, SECOND]) == []


@pytest.mark.parametrize("comment", [b"", b"made by hand PK\5\6"])
@pytest.mark.parametrize("extra", [b"\n", bytes(511), b"PK\5\6", bytes(18) + b"PK\5\6" + bytes(17)])
def test_bytes_after_the_archive_are_counted(comment: bytes, extra: bytes) -> None:
    archive = build(GOOD, comment=comment)
    [problem] = problems_of(archive + extra)
    noun = "byte follows" if len(extra) == 1 else "bytes follow"
    assert problem.found == f"{len(extra)} {noun} the end of the archive"
    assert problem.expected == f"the file to end at byte {len(archive)}"


@pytest.mark.parametrize("rest", [1, 21])
def test_truncated_archive_is_not_said_to_have_more_bytes(rest: int) -> None:
    """An archive that is an entry, such as .npz, may end within the part of the file that is there."""
    nested = Record(b"lattice/0000.npz", build(GOOD))
    archive = build([META, nested, SECOND])
    assert [problem.expected for problem in problems_of(archive[:-rest])] == [
        "one at the end: the file is truncated"
    ]


def test_zip64_sizes_in_directory_and_local_header() -> None:
    size = len(FIRST.data)
    wide = struct.pack("<2H2Q", 1, 16, size, size)
    full = {"size": 0xFFFFFFFF, "compressed": 0xFFFFFFFF, "local_size": 0xFFFFFFFF}
    assert problems_of(with_first(**full, extra=wide, local_extra=wide)) == []
    (problem,) = problems_of(with_first(**full))
    assert (problem.code, problem.where, problem.expected) == ("damaged", "", "2")


@pytest.mark.parametrize(
    ("records", "code"),
    [
        (with_first(flags=1), "kind"),
        (with_first(mode=stat.S_IFLNK | 0o777), "kind"),
        (with_first(mode=stat.S_IFCHR), "kind"),
        (with_first(mode=stat.S_IFDIR), "kind"),
        (with_first(method=12), "kind"),
        (with_first(size=640 * 10**6), "size"),
        (with_first(size=10), "size"),
        (with_first(local_name=b"lattice/0001.npy"), "damaged"),
        (with_first(local_method=8), "damaged"),
        (with_first(local_size=9), "damaged"),
        (with_first(crc=7), "damaged"),
        (with_first(offset=7), "damaged"),
        (with_first(offset=10**6), "damaged"),
        (with_first(compressed=4000), "damaged"),
        (with_first(disk=1), "kind"),
        (with_first(method=8, data=b"\xff" * 9), "damaged"),
        ([META, replace(PACKED, size=200), SECOND], "size"),
        ([META, replace(PACKED, data=PACKED.data + b"more"), SECOND], "damaged"),
        ([META, replace(PACKED, data=PACKED.data[:-9]), SECOND], "size"),
    ],
)
def test_invalid_entry_is_named_in_problem(records: list[Record], code: ProblemCode) -> None:
    problems = problems_of(records)
    assert (code, ENTRY) in located(problems), problems


ABSOLUTE = (b"/etc/passwd", b"C:/x.npy", b"C:x.npy", b"./C:/x.npy")
CLIMBING = (b"../lattice/0000.npy", b"lattice/../../x.npy", b"./../x.npy")


@pytest.mark.parametrize("name", [*ABSOLUTE, *CLIMBING, b"lattice\\0000.npy", b".//lattice/0000.npy"])
def test_escaping_names_are_rejected(name: bytes) -> None:
    (problem,) = problems_of([*GOOD, Record(name, b"x")])
    assert (problem.code, problem.where) == ("name", name.decode())


@pytest.mark.parametrize("name", [b"pile/0000.npy\0.txt", b"pile/0000.npy\n", b"\x1b[31mred.npy"])
def test_control_characters_are_rejected_and_not_echoed(name: bytes) -> None:
    (problem,) = problems_of([*GOOD, Record(name, npy(np.ones((2, 5))))])
    assert (problem.code, problem.expected) == ("name", "plain text")
    assert str(problem).isprintable()


def test_duplicate_names_views_and_metadata_are_reported() -> None:
    twin = Record(b"lattice/0001.npz", npz(z=DEPTH))
    assert problems_of([META, FIRST, FIRST, SECOND]) == [
        Problem("duplicate", "lattice/0000", f"2 entries were found ({ENTRY}, {ENTRY})", "one")
    ]
    problems = problems_of([META, META, FIRST, SECOND, twin])
    assert located(problems) == [("duplicate", "submission.json"), ("duplicate", "lattice/0001")]


def overlap_problem(start: int) -> Problem:
    found = f"the data from byte {start} overlaps that of {ENTRY}"
    return Problem("damaged", "lattice/0001.npy", found, "separate data")


@pytest.fixture
def good(tmp_path: Path) -> Path:
    path = tmp_path / "good.zip"
    path.write_bytes(build(GOOD))
    return path


def test_records_with_the_same_data_overlap() -> None:
    start = 30 + len(META.name) + len(META.data)
    problems = problems_of([META, FIRST, replace(SECOND, offset=start)])
    assert overlap_problem(start) in problems


def test_entry_inside_data_of_another_overlaps() -> None:
    """Check a local header inside a stored entry: names and checksums agree, only the byte ranges overlap."""
    inner = npy(DEPTH)
    quoted = build([Record(b"lattice/0001.npy", inner)])
    body = quoted[: 30 + 16 + len(inner)]
    outer = Record(b"lattice/0000.npy", body)
    at = 30 + len(META.name) + len(META.data) + 30 + len(outer.name)
    (overlap, other) = problems_of([META, outer, replace(SECOND, offset=at)])
    assert overlap == overlap_problem(at)
    assert (other.code, other.where) == ("syntax", ENTRY)


def _as_bsdtar(record: Record) -> Record:
    """Return an entry as libarchive writes it: names begin with ./, times and owner, sizes after deflated data."""
    extra = bytes.fromhex("55540d0007013f046b013f046b013f046b75780b000104000000000400000000")
    if record.name.endswith(b"/"):
        return Record(b"./" + record.name, mode=0o40755, extra=extra, local_extra=extra)
    packed = deflated(b"./" + record.name, record.data)
    crc, size, length = packed.crc, packed.size, len(packed.data)
    data = packed.data + struct.pack("<4s3L", b"PK\7\10", crc, length, size)
    return replace(packed, data=data, compressed=length, flags=8, extra=extra, local_extra=extra)


def test_archives_of_bsdtar_are_read_like_any_other(tmp_path: Path) -> None:
    path = tmp_path / "submission.zip"
    records = [Record(b"./", mode=0o40755), *map(_as_bsdtar, (META, Record(b"lattice/"), FIRST, SECOND))]
    path.write_bytes(build(records))
    assert check_archive(path, EXPECTED) == []
    with SubmissionReader(path, EXPECTED) as reader:
        assert reader.view_ids == ("lattice/0000", "lattice/0001")
        assert np.array_equal(reader.read("lattice/0000"), DEPTH)


def test_only_one_leading_dot_is_dropped_and_names_stay_unique() -> None:
    assert problems_of([Record(b"./", mode=0o40755), Record(b"./lattice/", mode=0o40755), *GOOD]) == []
    (problem,) = problems_of([*GOOD, replace(FIRST, name=b"./lattice/0000.npy")])
    assert (problem.code, problem.where) == ("duplicate", "lattice/0000")
    assert "(lattice/0000.npy, ./lattice/0000.npy)" in problem.found
    (problem,) = problems_of([*GOOD, replace(META, name=b"./submission.json")])
    assert (problem.code, problem.where) == ("duplicate", "submission.json")
    for name in (b"././lattice/0000.npy", b"./readme.txt", b"./lattice/0002.npy", b""):
        assert located(problems_of([*GOOD, Record(name)])) == [("unknown", name.decode() or "''")]
    huge = replace(FIRST, name=b"./lattice/0000.npy", size=640 * 10**6)
    assert ("size", "./lattice/0000.npy") in located(problems_of([META, huge, SECOND]))


@pytest.mark.parametrize("dot", [b"", b"./"])
def test_enclosing_folder_is_one_problem_behind_a_leading_dot(dot: bytes) -> None:
    wrapped = [replace(record, name=dot + b"sub/" + record.name) for record in GOOD]
    (problem,) = problems_of([Record(dot + b"sub/", mode=0o40755), *wrapped])
    assert (problem.code, problem.where) == ("unknown", "sub/submission.json")
    assert problem.expected.startswith("submission.json at the top level")


def test_unknown_entries_are_explained() -> None:
    explained = {
        "lattice/0002.npy": "",
        "LATTICE/0000.npy": "one of lattice, pile",
        "lattice/0000.tiff": SUFFIXES,
        "readme.txt": f"submission.json or <view_id> with {SUFFIXES}",
        "lattice/0000.NPY": SUFFIXES,
    }
    problems = problems_of([*GOOD, *(Record(name.encode()) for name in explained)])
    assert located(problems) == [("unknown", name) for name in explained]
    assert [problem.expected for problem in problems] == [*explained.values()]


def test_missing_views_and_metadata_are_reported() -> None:
    (problem,) = problems_of([META, FIRST])
    assert (problem.code, problem.where) == ("missing", "lattice/0001")
    assert problem.expected.startswith(SUFFIXES)
    assert located(problems_of([FIRST, SECOND])) == [("missing", "submission.json")]
    assert located(problems_of([replace(META, method=8), FIRST, SECOND])) == [("damaged", "submission.json")]
    assert located(problems_of([META])) == [("missing", "")]
    assert located(problems_of([])) == [("missing", "submission.json"), ("missing", "")]


def test_all_problems_are_reported_in_fixed_order() -> None:
    turned = Record(b"lattice/0001.npy", npy(DEPTH.T))
    bad = [replace(FIRST, flags=1), turned, Record(b"x"), Record(b"submission.json", b"{}")]
    problems = problems_of(bad)
    places = ["lattice/0000.npy", "x", "submission.json: method", "lattice/0001.npy"]
    assert located(problems) == [*zip(["kind", "unknown", "missing", "invalid"], places, strict=True)]
    assert problems_of(bad) == problems


@pytest.mark.parametrize(
    ("content", "code"),
    [
        (b"", "syntax"),
        (b"x" * 100, "syntax"),
        (build(GOOD)[:-40], "damaged"),
        (b"#!/bin/sh\n" + build(GOOD), "damaged"),
        (build(GOOD) + b"x", "damaged"),
        (build(GOOD, count=2), "damaged"),
        (build(GOOD, count=4), "damaged"),
        (build(GOOD).replace(b"PK\1\2", b"PK\1\3"), "damaged"),
        (build(GOOD).replace(struct.pack("<H8x", len(ENTRY)), struct.pack("<H8x", 60_000)), "damaged"),
        (build(GOOD, disk=1), "kind"),
        (build(GOOD, count=60_000), "size"),
    ],
)
def test_file_that_is_no_zip_is_one_problem(content: bytes, code: ProblemCode) -> None:
    assert located(problems_of(content)) == [(code, "")]


def test_path_that_is_no_file_is_one_problem(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("/dev/zero")
    paths: list[Path | str] = [tmp_path / "a.zip", tmp_path, tmp_path / "pipe", tmp_path / "link", "a\0b"]
    codes = ["missing", *["unreadable"] * 4]
    assert [located(check_archive(path, EXPECTED)) for path in paths] == [[(code, "")] for code in codes]


def test_reader_in_threads_and_after_closing(good: Path) -> None:
    with SubmissionReader(good, EXPECTED) as reader, ThreadPoolExecutor(4) as pool:
        assert reader.meta is not None
        for array in pool.map(reader.read, reader.view_ids * 50):
            np.testing.assert_array_equal(array, DEPTH)
        with pytest.raises(EntryError) as caught:
            reader.read("pile/0000")
        assert located(caught.value.problems) == [("missing", "pile/0000")]
    with pytest.raises(ValueError, match="is closed"):
        reader.read("lattice/0000")


def test_view_outlives_reader_and_file(tmp_path: Path) -> None:
    shape = (200, 300)
    values = np.random.default_rng(0).random(shape, dtype=np.float32)
    name = b"lattice/0000.npy"
    aligned = -(30 + len(name)) % 4
    path = tmp_path / "s.zip"
    path.write_bytes(build([Record(name, npy(values), local_extra=bytes(aligned)), META]))
    with SubmissionReader(path, {"lattice/0000": shape}) as reader:
        array = reader.read("lattice/0000")
    os.truncate(path, 0)
    assert not array.flags.writeable
    np.testing.assert_array_equal(array, values)


def test_unaligned_values_are_returned_aligned(tmp_path: Path) -> None:
    path = tmp_path / "s.zip"
    shape = (200, 300)
    for pad in range(4):
        path.write_bytes(build([META, replace(FIRST, data=npy(np.ones(shape)), local_extra=bytes(pad))]))
        with SubmissionReader(path, {"lattice/0000": shape}) as reader:
            assert reader.read("lattice/0000").flags.aligned


def test_file_truncated_while_open_raises_entry_error(good: Path) -> None:
    with SubmissionReader(good, EXPECTED) as reader:
        os.truncate(good, 100)
        with pytest.raises(EntryError) as caught:
            reader.read("lattice/0000")
    assert located(caught.value.problems) == [("damaged", ENTRY)]


def test_dropped_reader_closes_its_file(good: Path) -> None:
    before = len(list(Path("/proc/self/fd").iterdir()))
    for _ in range(5):
        assert SubmissionReader(good, EXPECTED).view_ids
    assert len(list(Path("/proc/self/fd").iterdir())) == before


MEGABYTE = 1 << 20


def run_with_peak_memory(run: Callable[[], list[Problem]]) -> tuple[list[Problem], int]:
    """Return the result of ``run`` and the peak memory that Python allocated meanwhile, bytes."""
    tracemalloc.start()
    try:
        return run(), tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_header_declaring_640_gb_allocates_nothing() -> None:
    data = npy_header("{'descr': '<f4', 'fortran_order': False, 'shape': (400000, 400000), }") + DEPTH.tobytes()
    records = [
        META,
        Record(b"lattice/0000.npy", data),
        Record(b"lattice/0001.npz", build([Record(b"a.npy", data)])),
    ]
    problems, peak_bytes = run_with_peak_memory(lambda: problems_of(records))
    assert located(problems) == [("invalid", ENTRY), ("invalid", "lattice/0001.npz (a.npy)")]
    assert {problem.found for problem in problems} == {"the shape is 400000 x 400000"}
    assert peak_bytes < MEGABYTE


@pytest.mark.parametrize("declared", [20_000_000, 176])
def test_zip_bomb_is_rejected_for_any_declared_size(declared: int) -> None:
    bomb = replace(deflated(b"lattice/0000.npy", bytes(20_000_000)), size=declared)
    content = build([META, bomb, SECOND])
    problems, peak_bytes = run_with_peak_memory(lambda: problems_of(content))
    assert located(problems) == [("size", ENTRY)]
    assert problems[0].expected == ("at most 4192" if declared > 4192 else "at most 1200")
    assert peak_bytes < MEGABYTE


def test_inflation_stops_one_byte_past_declared_size() -> None:
    bomb = replace(deflated(b"lattice/0000.npy", bytes(1_000_000)), size=3000)
    problems, peak_bytes = run_with_peak_memory(lambda: problems_of([META, bomb, SECOND]))
    assert problems == [Problem("size", ENTRY, "the data inflates to more than 3000 bytes", "the declared 3000")]
    assert peak_bytes < MEGABYTE // 2


def test_directory_of_a_million_entries_is_not_parsed() -> None:
    record = struct.pack("<4s4B4H3L5H2L", b"PK\1\2", *[0] * 8, 0, 0, 0, *[0] * 7)
    directory = record * 1_000_000
    wide = struct.pack("<4sQ2H2L4Q", b"PK\6\6", 44, 45, 45, 0, 0, 10**6, 10**6, len(directory), 0)
    locator = struct.pack("<4sLQL", b"PK\6\7", 0, len(directory), 1)
    end = struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 0xFFFF, 0xFFFF, 0xFFFFFFFF, 0xFFFFFFFF, 0)
    understated_end = struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 3, 3, len(directory), 0, 0)
    for tail, count in ((wide + locator + end, "1000000"), (understated_end, "3")):
        content = directory + tail
        problems, peak_bytes = run_with_peak_memory(lambda content=content: problems_of(content))  # type: ignore[misc]
        found = f"the zip directory declares {count} entries in 46000000 bytes"
        assert problems == [Problem("size", "", found, "at most 1036 entries in 530432 bytes")]
        assert peak_bytes < MEGABYTE
