"""Tests of archives that declare false sizes or have random damage: clear problems and bounded memory."""

from __future__ import annotations

import struct
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rebar_depth_bench.base.errors import Problem, ProblemCode
from tests.bench.submission import zips
from tests.bench.submission.conftest import Check, located
from tests.bench.submission.zips import (
    DEPTH,
    EXPECTED,
    FIRST,
    META,
    SECOND,
    Record,
    build,
    check_archive,
    deflated,
    npy,
    npy_header,
    npz,
    png,
)

ENTRY = "lattice/0000.npy"
MEGABYTE = 1 << 20


def run_with_peak_memory(run: Callable[[], list[Problem]]) -> tuple[list[Problem], int]:
    """Return the result of ``run`` and the peak memory that Python allocated meanwhile, bytes."""
    tracemalloc.start()
    try:
        return run(), tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_header_declaring_640_gb_allocates_nothing(check: Check) -> None:
    data = npy_header("{'descr': '<f4', 'fortran_order': False, 'shape': (400000, 400000), }") + DEPTH.tobytes()
    records = [
        META,
        Record(b"lattice/0000.npy", data),
        Record(b"lattice/0001.npz", build([Record(b"a.npy", data)])),
    ]
    problems, peak_bytes = run_with_peak_memory(lambda: check(records))
    assert located(problems) == [("invalid", ENTRY), ("invalid", "lattice/0001.npz (a.npy)")]
    assert {problem.found for problem in problems} == {"the shape is 400000 x 400000"}
    assert peak_bytes < MEGABYTE


@pytest.mark.parametrize("declared", [20_000_000, 176])
def test_zip_bomb_is_rejected_for_any_declared_size(check: Check, declared: int) -> None:
    bomb = replace(deflated(b"lattice/0000.npy", bytes(20_000_000)), size=declared)
    content = build([META, bomb, SECOND])
    problems, peak_bytes = run_with_peak_memory(lambda: check(content))
    assert located(problems) == [("size", ENTRY)]
    assert problems[0].expected == ("at most 4192" if declared > 4192 else "at most 1200")
    assert peak_bytes < MEGABYTE


def test_inflation_stops_one_byte_past_declared_size(check: Check) -> None:
    bomb = replace(deflated(b"lattice/0000.npy", bytes(1_000_000)), size=3000)
    problems, peak_bytes = run_with_peak_memory(lambda: check([META, bomb, SECOND]))
    assert problems == [Problem("size", ENTRY, "the data inflates to more than 3000 bytes", "the declared 3000")]
    assert peak_bytes < MEGABYTE // 2


@pytest.mark.parametrize(
    ("entry", "code"),
    [
        (
            replace(deflated(b"lattice/0000.npy", npy(DEPTH)), size=200),
            "size",
        ),
        (
            replace(deflated(b"lattice/0000.npy", npy(DEPTH)), data=deflated(b"", npy(DEPTH)).data + b"more"),
            "damaged",
        ),
        (
            replace(deflated(b"lattice/0000.npy", npy(DEPTH)), data=deflated(b"", npy(DEPTH)).data[:-9]),
            "size",
        ),
    ],
)
def test_deflated_data_of_wrong_length_is_rejected(check: Check, entry: Record, code: ProblemCode) -> None:
    assert located(check([META, entry, SECOND])) == [(code, ENTRY)]


def test_directory_of_a_million_entries_is_not_parsed(check: Check) -> None:
    record = struct.pack("<4s4B4H3L5H2L", b"PK\1\2", *[0] * 8, 0, 0, 0, *[0] * 7)
    directory = record * 1_000_000
    wide = struct.pack("<4sQ2H2L4Q", b"PK\6\6", 44, 45, 45, 0, 0, 10**6, 10**6, len(directory), 0)
    locator = struct.pack("<4sLQL", b"PK\6\7", 0, len(directory), 1)
    end = struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 0xFFFF, 0xFFFF, 0xFFFFFFFF, 0xFFFFFFFF, 0)
    understated_end = struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 3, 3, len(directory), 0, 0)
    for tail, count in ((wide + locator + end, "1000000"), (understated_end, "3")):
        content = directory + tail
        problems, peak_bytes = run_with_peak_memory(lambda content=content: check(content))  # type: ignore[misc]
        found = f"the zip directory declares {count} entries in 46000000 bytes"
        assert problems == [Problem("size", "", found, "at most 1036 entries in 530432 bytes")]
        assert peak_bytes < MEGABYTE


def _valid_archives(folder: Path) -> list[bytes]:
    units = (DEPTH * 1000).astype(np.uint16)
    views = {
        ".npy": npy(DEPTH),
        ".npz": npz(z=DEPTH),
        ".png": png(units),
        ".exr": zips.exr(folder / "a.exr", {"Z": DEPTH}),
    }
    stored = [build([META, FIRST, Record(b"lattice/0001" + s.encode(), data)]) for s, data in views.items()]
    return [*stored, build([META, FIRST, deflated(b"lattice/0001.npy", npy(DEPTH))])]


def _mutate(content: bytes, random: np.random.Generator) -> bytes:
    data = bytearray(content)
    kind = random.integers(4)
    if kind == 0:
        for at in random.integers(len(data), size=random.integers(1, 4)):
            data[at] = random.integers(256)
    elif kind == 1:
        del data[random.integers(len(data)) :]
    elif kind == 2:
        at = random.integers(len(data) - 4)
        data[at : at + 4] = random.choice([b"\xff\xff\xff\xff", bytes(4), b"\1\0\0\0", b"PK\5\6", b"\0\0\0\x80"])
    else:
        first, second = sorted(random.integers(len(data), size=2))
        data[first:second] = data[first:second][: random.integers(20)]
    return bytes(data)


@pytest.mark.slow
def test_random_damage_gives_printable_problems(tmp_path: Path) -> None:
    random = np.random.default_rng(20251121)
    samples = _valid_archives(tmp_path)
    rejected_count = 0
    for number in range(700):
        path = tmp_path / "s.zip"
        path.write_bytes(_mutate(samples[number % len(samples)], random))
        problems = check_archive(path, EXPECTED)
        rejected_count += bool(problems)
        assert all(str(problem).isprintable() and len(str(problem)) < 1000 for problem in problems)
    assert 500 < rejected_count < 700


FUZZ_SCRIPT = """
import resource, sys, numpy as np
resource.setrlimit(resource.RLIMIT_AS, (2 << 30, 2 << 30))
from pathlib import Path
from {package}.test_hostile import _mutate
from rebar_depth_bench.submission.entries import FORMATS
from rebar_depth_bench.submission import EntryError
random, outcomes = np.random.default_rng(7), dict()
for path in sorted(Path(sys.argv[1]).iterdir()):
    for _ in range(250):
        data = _mutate(path.read_bytes(), random)
        try:
            FORMATS[path.suffix].decode(path.name, memoryview(data), (3, 4), 1.0)
            outcome = "decoded"
        except EntryError:
            outcome = "refused"
        outcomes[path.suffix, outcome] = outcomes.get((path.suffix, outcome), 0) + 1
assert len(outcomes) == 8, outcomes
print("done")
"""


@pytest.mark.slow
def test_damaged_data_is_decoded_or_rejected_within_2_gb(tmp_path: Path) -> None:
    """Decode in a subprocess, so that a crash inside a C library or a huge allocation is detected."""
    units = (DEPTH * 1000).astype(np.uint16)
    (tmp_path / "a.npy").write_bytes(npy(DEPTH))
    (tmp_path / "a.npz").write_bytes(npz(z=DEPTH))
    (tmp_path / "a.png").write_bytes(png(units))
    zips.exr(tmp_path / "a.exr", {"Z": DEPTH})
    root = Path(__file__).parents[len((__package__ or "").split("."))]
    run = subprocess.run(
        [sys.executable, "-c", FUZZ_SCRIPT.format(package=__package__), str(tmp_path)],
        check=False, capture_output=True, text=True, cwd=root, timeout=120,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr[-2000:]
    assert run.stdout.endswith("done\n")
