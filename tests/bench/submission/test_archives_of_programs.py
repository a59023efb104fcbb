"""Archives as the programs of Windows and macOS write them, and what is refused although they write it."""

from __future__ import annotations

import json
import struct
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import rebar_depth_bench as rdb
from rebar_depth_bench.base.errors import Problem
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.submission import SubmissionReader
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
    located,
    npy,
    problems_of,
)
from tests.commands import run_in_process

APPLE_DOUBLE = bytes.fromhex("00051607 00020000") + b"Mac OS X        " + bytes(58)
"""Start of an AppleDouble file, as macOS writes for the extended attributes of a file: magic, version, filler."""
LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"4d" * 32 + b"\nsize 12345\n"
"""Pointer file, as the specification of git LFS defines it."""


def _as_powershell(record: Record) -> Record:
    """Return an entry as Compress-Archive of PowerShell 5.1 writes it: ZipArchive of .NET, host 0, no mode."""
    entry = deflated(record.name.replace(b"/", b"\\"), record.data)
    return replace(entry, host=0, mode=0)


def _as_archive_utility(record: Record) -> Record:
    """Return an entry as macOS writes it: host 3, times in a field UX, sizes after the deflated data."""
    entry = deflated(record.name, record.data)
    times = struct.pack("<2H2L", 0x5855, 8, 1_700_000_000, 1_700_000_000)
    data = entry.data + struct.pack("<4s3L", b"PK\7\10", entry.crc or 0, len(entry.data), entry.size or 0)
    local = times[:2] + struct.pack("<H", 12) + times[4:] + bytes(4)
    return replace(entry, data=data, compressed=len(entry.data), flags=8, extra=times, local_extra=local)


MAC_FILES = [
    Record(b"__MACOSX/", mode=0o40775),
    Record(b"__MACOSX/._submission.json", APPLE_DOUBLE),
    Record(b"__MACOSX/lattice/._0000.npy", APPLE_DOUBLE),
    Record(b"lattice/._0001.npy", APPLE_DOUBLE),
    Record(b"lattice/.DS_Store", b"\0\0\0\1Bud1"),
    Record(b".DS_Store", b"\0\0\0\1Bud1"),
]


@pytest.mark.parametrize(
    "records",
    [
        [_as_powershell(record) for record in (META, FIRST, SECOND)],
        # CreateFromDirectory of .NET Framework 4.5 writes empty folders, and the flag of UTF-8 for other names.
        [Record(b"lattice\\", host=0, mode=0), *(replace(_as_powershell(one), flags=0x800) for one in GOOD)],
        # 7-Zip for Windows: host 0, slashes, the attributes of FAT in the low bytes.
        [Record(b"lattice/", host=0, mode=0), *(replace(record, host=0, mode=0) for record in GOOD)],
        [Record(b"lattice/", mode=0o40755), *map(_as_archive_utility, GOOD)],
        [*map(_as_archive_utility, [META, *MAC_FILES[1:4], FIRST, SECOND]), *MAC_FILES],
        [*(replace(record, name=b"./" + record.name) for record in [*GOOD, *MAC_FILES])],
        [*map(_as_powershell, [*GOOD, *MAC_FILES[1:]])],
    ],
)
def test_archives_of_windows_and_macos_are_read(records: list[Record], tmp_path: Path) -> None:
    path = tmp_path / "s.zip"
    path.write_bytes(build(records))
    with SubmissionReader(path, EXPECTED) as reader:
        assert list(reader.problems()) == []
        assert reader.view_ids == ("lattice/0000", "lattice/0001")
        assert np.array_equal(reader.read("lattice/0000"), DEPTH)
        ignored = sum(b"._" in record.name or b"DS_S" in record.name for record in records)
        ignored += any(record.name.endswith(b"__MACOSX/") for record in records)
        assert [f": {ignored} (" in note for note in reader.notes] == [True] * bool(ignored)


def test_backslashes_of_other_systems_are_refused() -> None:
    """Info-ZIP on Linux (host 3) stores a backslash that is part of a file's name; 11 is NTFS, 19 is macOS."""
    for host in (3, 10, 11, 19):
        (problem,) = problems_of([META, replace(_as_powershell(FIRST), host=host), SECOND])[:1]
        assert (problem.code, problem.where) == ("name", "lattice\\0000.npy")
    undecodable = replace(_as_powershell(FIRST), name=b"lattice\\\xff0000.npy", flags=0x800)
    assert ("name", "lattice/\\xff0000.npy") in located(problems_of([*GOOD, undecodable]))


@pytest.mark.parametrize(
    "name",
    [
        b"..\\lattice\\0000.npy",
        b"lattice\\..\\..\\x.npy",
        b"C:\\x.npy",
        b"C:x.npy",
        b"\\x.npy",
        b"\\\\host\\x.npy",
    ],
)
def test_escaping_names_with_backslashes_are_refused(name: bytes) -> None:
    (problem,) = problems_of([*GOOD, Record(name, b"x", host=0)])
    assert (problem.code, problem.where) == ("name", name.decode().replace("\\", "/"))


def test_both_spellings_of_a_name_are_a_duplicate() -> None:
    assert problems_of([*GOOD, _as_powershell(FIRST)]) == [
        Problem("duplicate", "lattice/0000", "2 entries were found (lattice/0000.npy, lattice/0000.npy)", "one")
    ]
    differs = replace(_as_powershell(FIRST), local_name=b"lattice/0000.npy")
    assert ("damaged", "lattice/0000.npy") in located(problems_of([META, differs, SECOND]))


def test_enclosing_folder_of_windows_or_macos_is_named() -> None:
    wrapped = [replace(record, name=b"sub/" + record.name) for record in GOOD]
    for records in (list(map(_as_powershell, wrapped)), [*wrapped, Record(b"__MACOSX/sub/._a", APPLE_DOUBLE)]):
        (problem,) = problems_of(records)
        assert (problem.code, problem.where) == ("unknown", "sub/submission.json")


def test_ignored_entries_keep_all_limits() -> None:
    name = b"__MACOSX/lattice/._0000.npy"
    start = 30 + len(META.name) + len(META.data)
    hidden = {
        "size": replace(deflated(name, b"x"), size=640 * 10**6),
        "kind": Record(name, b"x", mode=0o120777),
        "damaged": Record(name, FIRST.data, offset=start),
    }
    for code, record in hidden.items():
        assert (code, name.decode()) in located(problems_of([*GOOD, record]))
    assert located(problems_of([*GOOD, Record(b"__MACOSX/../x", b"x")])) == [("name", "__MACOSX/../x")]
    many = [Record(b"__MACOSX/._%d" % number) for number in range(1100)]
    assert located(problems_of([*GOOD, *many])) == [("size", "")]
    other = [b"__MACOSX", b"lattice/__MACOSX/x", b"lattice/DS_Store", b"lattice/.0000.npy", b"a._b"]
    assert located(problems_of([*GOOD, *map(Record, other)])) == [("unknown", one.decode()) for one in other]


def test_metadata_of_windows_and_pointers_of_git_lfs() -> None:
    """Set-Content -Encoding utf8 of PowerShell 5.1 begins with a byte order mark; its ``>`` writes UTF-16."""
    assert problems_of([replace(META, data=b"\xef\xbb\xbf" + META.data), FIRST, SECOND]) == []
    (problem,) = problems_of([replace(META, data=META.data.decode().encode("utf-16")), FIRST, SECOND])
    assert (problem.where, problem.found) == ("submission.json", "the text is UTF-16")
    for record in (replace(FIRST, data=LFS), deflated(FIRST.name, LFS)):
        (problem,) = problems_of([META, record, SECOND])
        assert (problem.where, "git lfs pull" in problem.found) == ("lattice/0000.npy", True)
    (problem,) = problems_of(LFS)
    assert "is a pointer of git LFS" in problem.found


@pytest.mark.parametrize("program", ["powershell", "macos"])
def test_score_is_that_of_the_plain_archive(program: str, tiny_root: Path, tmp_path: Path) -> None:
    """Predictions 1.1 times the truth: AbsRel is 0.1, the rank error 0.1 / 1.1."""
    views = [view for view in open_folder(tiny_root).expected_views() if view.startswith("lattice/")]
    plain, other = tmp_path / "plain.zip", tmp_path / "other.zip"
    with zipfile.ZipFile(plain, "w") as zipped, zipfile.ZipFile(other, "w", zipfile.ZIP_DEFLATED) as written:
        content = {"submission.json": b'{"method": "x"}'}
        for row in rdb.load(tiny_root, "lattice"):
            content[f"{row['view_id']}.npy"] = npy((1.1 * row["left_depth"]).astype("<f4"))
        for name, data in content.items():
            zipped.writestr(name, data)
            info = zipfile.ZipInfo(name.replace("/", "\\") if program == "powershell" else name)
            info.create_system = 0 if program == "powershell" else 3
            written.writestr(info, data)
            if program == "macos":
                written.writestr(f"__MACOSX/{name.rpartition('/')[0]}/._{name.rpartition('/')[2]}", APPLE_DOUBLE)
    assert len(content) == len(views) + 1
    results, notes = [], []
    for archive in (plain, other):
        scored = run_in_process(main, "score", archive, "--data", tiny_root, "--json", tmp_path / "result.json")
        checked = run_in_process(main, "check", archive, "--data", tiny_root)
        assert (scored.returncode, checked.returncode) == (0, 0), scored.stderr + checked.stderr
        results.append(json.loads((tmp_path / "result.json").read_bytes()))
        notes.append([f"are ignored: {len(content)}" in one.stderr for one in (scored, checked)])
    assert [result["submission"].pop("sha256") != "" for result in results] == [True, True]
    assert results[0] == results[1]
    assert notes == [[False] * 2, [program == "macos"] * 2]
    table = results[1]["tables"]["lattice"]
    assert table["native"]["abs_rel"] == pytest.approx(0.1, abs=1e-6)
    assert table["rank_error"] == pytest.approx(0.1 / 1.1, abs=1e-6)
