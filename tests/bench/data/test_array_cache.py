"""Tests of the array cache: round trip, damage, concurrent processes, size limit and unusable folders."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.data.cache import (
    ArrayCache,
    CacheContent,
    ViewArrays,
    cache_folder,
    clear,
    entries,
    open_cache,
)

DTYPES = {"index": np.uint32, "inside": np.bool_}
COUNT = 4


def views(view_ids: Collection[str] | None = None, *, count: int = COUNT) -> Iterator[ViewArrays]:
    for n in reversed(range(count)):  # In another order than that of the content.
        arrays = {"index": np.arange(n) + 10 * n, "inside": np.arange(n) % 2 == 0}
        if view_ids is None or f"lattice/{n:04}" in view_ids:
            yield ViewArrays(f"lattice/{n:04}", arrays, (0.1 * n, -1e-300))


def content(
    extract: Callable[[Collection[str] | None], Iterator[ViewArrays]] = views,
    *,
    count: int = COUNT,
    inputs: Any = "a",
) -> CacheContent:
    return CacheContent(
        task="ground truth",
        inputs={"digest": inputs},
        dtypes=DTYPES,
        view_ids=tuple(f"lattice/{n:04}" for n in range(count)),
        extract=extract,
        is_sound=lambda view: bool((view.arrays["index"] < 100).all()),
    )


def indices(cache: ArrayCache) -> list[list[int]]:
    return [cache.view(position).arrays["index"].tolist() for position in range(len(cache))]


EXPECTED = [[], [10], [20, 21], [30, 31, 32]]


@pytest.fixture(autouse=True)
def folder(empty_cache: Path) -> Path:
    return empty_cache


@pytest.fixture
def entry(folder: Path) -> Path:
    """Write the entry of ``content()`` and return its file."""
    open_cache(content())
    [path] = folder.iterdir()
    return path


def check_that_it_is_not_extracted(**options: Any) -> None:
    """Check that the values of ``content()`` are in the cache and intact."""

    def extract(view_ids: Collection[str] | None) -> Iterator[ViewArrays]:
        raise AssertionError("extracted although it is there")

    assert indices(open_cache(content(extract, **options))) == EXPECTED[: options.get("count", COUNT)]


class Recorder:
    """Extraction that records the ids with which it is called."""

    def __init__(self, delay_s: float = 0) -> None:
        self.called: list[Collection[str] | None] = []
        self.delay_s = delay_s

    def __call__(self, view_ids: Collection[str] | None) -> Iterator[ViewArrays]:
        self.called.append(view_ids)
        time.sleep(self.delay_s)
        return views(view_ids)


def flip(path: Path, position: int, mask: int = 1) -> None:
    """Change one byte of a file in place, which open readers see."""
    with path.open("r+b") as file:
        file.seek(position, os.SEEK_END if position < 0 else os.SEEK_SET)
        [byte] = file.read(1)
        file.seek(-1, os.SEEK_CUR)
        file.write(bytes([byte ^ mask]))


def test_round_trip_extracts_once(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    open_cache(content())
    check_that_it_is_not_extracted()
    cache = open_cache(content())
    assert cache.view_ids == content().view_ids
    assert cache.numbers == tuple((0.1 * n, -1e-300) for n in range(COUNT))
    for position, expected in enumerate(reversed([*views()])):
        view = cache.view(position)
        assert (view.view_id, view.numbers) == (expected.view_id, expected.numbers)
        assert {name: array.dtype for name, array in view.arrays.items()} == DTYPES
        assert view.arrays["inside"].tolist() == expected.arrays["inside"].tolist()
    assert folder.stat().st_mode & 0o077 == 0
    assert capsys.readouterr().err == ""
    for inputs in ("b", "a"):
        open_cache(content(inputs=inputs))
    assert len([*folder.iterdir()]) == 2, "other inputs make another entry"
    for count in (0, 1):
        open_cache(content(partial(views, count=count), count=count))
        check_that_it_is_not_extracted(count=count)


@pytest.mark.slow
def test_every_changed_byte_is_detected(entry: Path, capsys: pytest.CaptureFixture[str]) -> None:
    intact = entry.read_bytes()
    for position in range(len(intact)):
        flip(entry, position, 1 << position % 8)
        assert indices(open_cache(content())) == EXPECTED
        open_cache(content())
        assert entry.read_bytes() == intact
        assert capsys.readouterr().err.count("\n") == 1


def change_block(data: bytes, change: Callable[[list[dict[str, Any]]], object]) -> bytes:
    """Return an entry with changed blocks in its index, whose checksum is right."""
    length = int.from_bytes(data[-8:], "little")
    index = json.loads(data[-40 - length : -40])
    change(index["blocks"])
    encoded = json.dumps(index).encode()
    return data[: -40 - length] + encoded + hashlib.sha256(encoded).digest() + len(encoded).to_bytes(8, "little")


@pytest.mark.parametrize(
    "change",
    [
        lambda intact: intact[:-2],
        lambda _: b"",
        lambda intact: intact + b"1234",
        lambda intact: intact[:-8] + b"\xff" * 8,
        lambda intact: change_block(intact, lambda blocks: blocks.pop()),
        lambda intact: change_block(intact, lambda blocks: blocks[1].update(count=-1)),
    ],
)
def test_damaged_entry_is_written_again(
    entry: Path, change: Callable[[bytes], bytes], capsys: pytest.CaptureFixture[str]
) -> None:
    intact = entry.read_bytes()
    entry.write_bytes(change(intact))
    assert indices(open_cache(content())) == EXPECTED
    [line] = capsys.readouterr().err.splitlines()
    assert f"{entry}: the cache is damaged, and its values are computed again" in line
    assert entry.read_bytes() == intact


@pytest.mark.parametrize("kind", ["other", "link", "folder", "pipe"])
def test_what_is_no_entry_is_not_read(
    entry: Path, tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    intact, target = entry.read_bytes(), tmp_path / "target"
    if kind == "other":
        open_cache(content(inputs="b"))
        (entry.parent / content(inputs="b").file_name).replace(entry)
    else:
        entry.rename(target)
        make: dict[str, Callable[[], object]] = {
            "link": partial(entry.symlink_to, target),
            "folder": entry.mkdir,
            "pipe": partial(os.mkfifo, entry),
        }
        make[kind]()
    assert indices(open_cache(content())) == EXPECTED
    if kind in ("folder", "pipe"):  # They are never deleted, so the entry cannot be written.
        assert entry.is_dir() or entry.is_fifo()
        assert "not cached" in capsys.readouterr().err
    else:
        assert capsys.readouterr().err.count("\n") == 1
        assert not entry.is_symlink()
        assert entry.read_bytes() == intact
    assert not target.exists() or target.read_bytes() == intact


def test_damage_found_by_several_threads_is_reported_once(
    folder: Path, entry: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    extract = Recorder(delay_s=0.05)
    cache = open_cache(content(extract))
    flip(entry, 0)
    with ThreadPoolExecutor(8) as pool:
        read = [*pool.map(lambda _: cache.view(COUNT - 1).arrays["index"].tolist(), range(16))]
    assert read == [EXPECTED[-1]] * 16
    assert indices(cache) == EXPECTED
    assert extract.called == [[f"lattice/{COUNT - 1:04}"]] * 17  # The other views are intact.
    assert capsys.readouterr().err.count("\n") == 1
    assert [*folder.iterdir()] == []
    open_cache(content())
    check_that_it_is_not_extracted()


@pytest.mark.parametrize("size", [0, 20])
def test_entry_truncated_while_open_is_read_from_the_dataset(entry: Path, size: int) -> None:
    cache = open_cache(content())
    os.truncate(entry, size)
    assert indices(cache) == EXPECTED


def test_failed_extraction_leaves_no_file(folder: Path) -> None:
    def failing(_: Collection[str] | None) -> Iterator[ViewArrays]:
        yield from views(count=2)
        raise KeyError("the dataset is damaged")

    with pytest.raises(KeyError):
        open_cache(content(failing))
    assert [*folder.iterdir()] == []


def test_least_recently_used_entries_are_deleted_first(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for age_s, inputs in ((300, "a"), (200, "b"), (100, "c")):
        open_cache(content(inputs=inputs))
        path = folder / content(inputs=inputs).file_name
        os.utime(path, (time.time() - age_s,) * 2)
    size_bytes = path.stat().st_size
    foreign = folder / "photograph.jpg"
    foreign.write_bytes(bytes(10 * size_bytes))
    monkeypatch.setenv("REBAR_MAX_CACHE_BYTES", str(3 * size_bytes))
    check_that_it_is_not_extracted(inputs="a")
    open_cache(content(inputs="d"))
    kept = {content(inputs=inputs).file_name for inputs in "acd"}
    assert {path.name for path in folder.iterdir()} == {*kept, foreign.name}
    assert next(entry.path.name for entry in entries(folder)) == content(inputs="c").file_name


def test_entry_larger_than_limit_is_used_and_not_kept(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("REBAR_MAX_CACHE_BYTES", "10")
    assert indices(open_cache(content())) == EXPECTED
    assert [*folder.iterdir()] == []
    assert "at most 10 bytes (REBAR_MAX_CACHE_BYTES)" in capsys.readouterr().err


def test_invalid_size_limit_is_reported_before_extraction(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("REBAR_MAX_CACHE_BYTES", "lots")
    extract = Recorder()
    with pytest.raises(InputError, match="REBAR_MAX_CACHE_BYTES is lots"):
        open_cache(content(extract))
    assert extract.called == []


def test_only_files_of_own_pattern_are_cleared(folder: Path, entry: Path, tmp_path: Path) -> None:
    cache = open_cache(content())
    outside = tmp_path / "outside"
    outside.write_text("kept")
    names = ("0" * 64 + ".truth", "1" * 64 + ".truth", "2" * 63 + ".truth", "3" * 64 + ".truth.zip")
    kept = link, directory, *files = [folder / name for name in names]
    link.symlink_to(outside)
    directory.mkdir()
    for file in files:
        file.write_text("")
    unfinished = folder / f".{entry.name}.00ab12cd.tmp"
    unfinished.write_text("")
    assert {file.path for file in clear(folder)} == {entry, unfinished}
    assert {*folder.iterdir()} == {*kept}
    assert outside.read_text() == "kept"
    assert indices(cache) == EXPECTED, "an open cache stays readable"


@pytest.mark.parametrize("obstacle", ["file", "read-only", "link", "no home"])
def test_views_are_computed_one_by_one_without_cache_folder(
    folder: Path,
    tmp_path: Path,
    obstacle: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    other = tmp_path / "other"
    other.mkdir()
    folder.parent.mkdir()
    if obstacle == "file":
        folder.write_text("no folder")
    elif obstacle == "link":
        folder.symlink_to(other)
    elif obstacle == "read-only":
        monkeypatch.setenv("XDG_CACHE_HOME", "/proc")  # Also for root.
    else:
        monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # The specification asks to ignore it.
        monkeypatch.setenv("HOME", "/dev/null")
    extract = Recorder()
    cache = open_cache(content(extract))
    assert cache.numbers == tuple((0.1 * n, -1e-300) for n in range(COUNT))
    assert indices(cache) == EXPECTED
    assert extract.called == [None, *([view_id] for view_id in cache.view_ids)]
    assert [*other.iterdir()] == []
    [line] = capsys.readouterr().err.splitlines()
    assert "computed whenever it is needed" in line


def test_entry_of_read_only_folder_is_used(folder: Path, entry: Path) -> None:
    folder.chmod(0o500)
    try:
        check_that_it_is_not_extracted()
    finally:
        folder.chmod(0o700)


@pytest.mark.parametrize("given", ["", "relative"])
def test_cache_lies_in_home_without_xdg_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: str
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", given)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert cache_folder() == tmp_path / "home" / ".cache" / "rebar-depth-bench"


def start_process(delay_s: float) -> subprocess.Popen[str]:
    """Start a process that prints a line for each view, and waits, when it is extracted."""
    code = f"""
        import time
        from {__name__} import EXPECTED, content, indices, views
        from rebar_depth_bench.data.cache import open_cache

        def extract(view_ids):
            for view in views(view_ids):
                print("view", flush=True)
                time.sleep({delay_s})
                yield view

        assert indices(open_cache(content(extract))) == EXPECTED
    """
    command = [sys.executable, "-c", textwrap.dedent(code)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.slow
@pytest.mark.parametrize("damaged", [False, True])
def test_concurrent_processes_write_the_same_entry(folder: Path, damaged: bool) -> None:
    if damaged:
        open_cache(content())
        flip(folder / content().file_name, -1)
    processes = [start_process(0.2) for _ in range(3)]
    outputs = [process.communicate() for process in processes]
    for process, (_, errors) in zip(processes, outputs, strict=True):
        assert process.returncode == 0, errors
        assert errors.count("\n") <= int(damaged)  # A process may start when another one is done.
    assert len([*folder.iterdir()]) == 1
    check_that_it_is_not_extracted()


@pytest.mark.slow
def test_killed_process_leaves_no_usable_entry(folder: Path) -> None:
    process = start_process(60)
    assert process.stdout is not None
    assert process.stdout.readline() == "view\n"
    process.send_signal(signal.SIGKILL)
    process.communicate()
    [path] = folder.iterdir()
    assert path.suffix == ".tmp"
    assert indices(open_cache(content())) == EXPECTED
    assert len(entries(folder)) == len(clear(folder)) == 2
