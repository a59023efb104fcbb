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


def unexpected_extraction(view_ids: Collection[str] | None = None) -> Iterator[ViewArrays]:
    raise AssertionError("extracted although it is there")


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


def only_file(folder: Path) -> Path:
    [path] = folder.iterdir()
    return path


def flip(path: Path, position: int, mask: int = 1) -> None:
    """Change one byte of a file in place, which open readers see."""
    with path.open("r+b") as file:
        file.seek(position, os.SEEK_END if position < 0 else os.SEEK_SET)
        [byte] = file.read(1)
        file.seek(-1, os.SEEK_CUR)
        file.write(bytes([byte ^ mask]))


def test_round_trip_extracts_once(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    open_cache(content())
    cache = open_cache(content(unexpected_extraction))
    assert cache.view_ids == content().view_ids
    assert cache.numbers == tuple((0.1 * n, -1e-300) for n in range(COUNT))
    for position, expected in enumerate(reversed([*views()])):
        view = cache.view(position)
        assert (view.view_id, view.numbers) == (expected.view_id, expected.numbers)
        for name, dtype in DTYPES.items():
            assert view.arrays[name].dtype == dtype
            assert view.arrays[name].tolist() == expected.arrays[name].tolist()
    assert folder.stat().st_mode & 0o077 == 0
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("count", [0, 1])
def test_cache_of_zero_or_one_view_is_reused(count: int) -> None:
    open_cache(content(lambda _: views(count=count), count=count))
    assert len(open_cache(content(unexpected_extraction, count=count))) == count


def test_other_inputs_make_another_entry(folder: Path) -> None:
    for inputs in ("a", "b", "a"):
        open_cache(content(inputs=inputs))
    assert len([*folder.iterdir()]) == 2


def test_every_changed_byte_is_detected(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    open_cache(content())
    path = only_file(folder)
    intact = path.read_bytes()
    for position in range(len(intact)):
        flip(path, position, 1 << position % 8)
        assert indices(open_cache(content())) == EXPECTED
        open_cache(content())
        assert path.read_bytes() == intact
        assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("change", [lambda blocks: blocks.pop(), lambda blocks: blocks[1].update(count=-1)])
def test_index_with_a_valid_checksum_is_checked(
    folder: Path, change: Callable[[list[dict[str, Any]]], object], capsys: pytest.CaptureFixture[str]
) -> None:
    open_cache(content())
    path = only_file(folder)
    data = path.read_bytes()
    length = int.from_bytes(data[-8:], "little")
    index = json.loads(data[-40 - length : -40])
    change(index["blocks"])
    encoded = json.dumps(index).encode()
    trailer = hashlib.sha256(encoded).digest() + len(encoded).to_bytes(8, "little")
    path.write_bytes(data[: -40 - length] + encoded + trailer)
    assert indices(open_cache(content())) == EXPECTED
    assert "the cache is damaged" in capsys.readouterr().err


@pytest.mark.parametrize("damage", ["cut", "empty", "longer", "trailer", "other", "folder", "link", "pipe"])
def test_damaged_entry_is_written_again(
    folder: Path, tmp_path: Path, damage: str, capsys: pytest.CaptureFixture[str]
) -> None:
    open_cache(content())
    path = only_file(folder)
    intact = path.read_bytes()
    target = tmp_path / "target"
    if damage in ("folder", "link", "pipe"):
        path.rename(target)
        if damage == "folder":
            path.mkdir()
        elif damage == "link":
            path.symlink_to(target)
        else:
            os.mkfifo(path)
    elif damage == "other":
        open_cache(content(inputs="b"))
        max(folder.iterdir(), key=lambda file: file != path).replace(path)
    else:
        changed = {
            "cut": intact[:-2],
            "empty": b"",
            "longer": intact + b"1234",
            "trailer": intact[:-8] + b"\xff" * 8,
        }
        path.write_bytes(changed[damage])
    assert indices(open_cache(content())) == EXPECTED
    if damage in ("folder", "pipe"):  # They are never deleted, so the entry cannot be written.
        assert path.is_dir() or path.is_fifo()
        assert "not cached" in capsys.readouterr().err
        return
    assert capsys.readouterr().err.count("\n") == 1
    assert not path.is_symlink()
    assert path.read_bytes() == intact
    assert not target.exists() or target.read_bytes() == intact


def test_damage_found_by_several_threads_is_reported_once(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    extracted = []

    def extract(view_ids: Collection[str] | None) -> Iterator[ViewArrays]:
        extracted.append(view_ids)
        time.sleep(0.05)
        return views(view_ids)

    cache = open_cache(content(extract))
    flip(only_file(folder), 0)
    with ThreadPoolExecutor(8) as pool:
        read = [*pool.map(lambda _: cache.view(COUNT - 1).arrays["index"].tolist(), range(16))]
    assert read == [EXPECTED[-1]] * 16
    assert indices(cache) == EXPECTED
    assert extracted == [None, *[[f"lattice/{COUNT - 1:04}"]] * 17]  # The other views are intact.
    assert capsys.readouterr().err.count("\n") == 1
    assert [*folder.iterdir()] == []
    open_cache(content())
    assert indices(open_cache(content(unexpected_extraction))) == EXPECTED


@pytest.mark.parametrize("size", [0, 20])
def test_entry_truncated_while_open_is_read_from_the_dataset(folder: Path, size: int) -> None:
    cache = open_cache(content())
    os.truncate(only_file(folder), size)
    assert indices(cache) == EXPECTED


def test_failed_extraction_leaves_no_file(folder: Path) -> None:
    def failing(_: Collection[str] | None) -> Iterator[ViewArrays]:
        yield from views(count=2)
        raise KeyError("the dataset is damaged")

    with pytest.raises(KeyError):
        open_cache(content(failing))
    assert [*folder.iterdir()] == []


def test_open_cache_is_readable_after_clearing(folder: Path) -> None:
    cache = open_cache(content())
    assert len(clear(folder)) == 1
    assert [*folder.iterdir()] == []
    assert indices(cache) == EXPECTED


def test_least_recently_used_entries_are_deleted_first(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for age_s, inputs in ((300, "a"), (200, "b"), (100, "c")):
        open_cache(content(inputs=inputs))
        path = folder / content(inputs=inputs).file_name
        os.utime(path, (time.time() - age_s,) * 2)
    size_bytes = path.stat().st_size
    foreign = folder / "photograph.jpg"
    foreign.write_bytes(bytes(10 * size_bytes))
    monkeypatch.setenv("REBAR_MAX_CACHE_BYTES", str(3 * size_bytes))
    open_cache(content(unexpected_extraction, inputs="a"))
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
    with pytest.raises(InputError, match="REBAR_MAX_CACHE_BYTES is lots"):
        open_cache(content(unexpected_extraction))


def test_only_files_of_own_pattern_are_cleared(folder: Path, tmp_path: Path) -> None:
    open_cache(content())
    path = only_file(folder)
    outside = tmp_path / "outside"
    outside.write_text("kept")
    names = ("0" * 64 + ".truth", "1" * 64 + ".truth", "2" * 63 + ".truth", "3" * 64 + ".truth.zip")
    kept = link, directory, *files = [folder / name for name in names]
    link.symlink_to(outside)
    directory.mkdir()
    for file in files:
        file.write_text("")
    unfinished = folder / f".{path.name}.00ab12cd.tmp"
    unfinished.write_text("")
    assert {file.path for file in clear(folder)} == {path, unfinished}
    assert {*folder.iterdir()} == {*kept}
    assert outside.read_text() == "kept"


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
    extracted = []

    def extract(view_ids: Collection[str] | None) -> Iterator[ViewArrays]:
        extracted.append(view_ids)
        return views(view_ids)

    cache = open_cache(content(extract))
    assert cache.numbers == tuple((0.1 * n, -1e-300) for n in range(COUNT))
    assert indices(cache) == EXPECTED
    assert extracted == [None, *([view_id] for view_id in cache.view_ids)]
    assert [*other.iterdir()] == []
    [line] = capsys.readouterr().err.splitlines()
    assert "computed whenever it is needed" in line


@pytest.mark.slow
@pytest.mark.parametrize("limit_bytes", [0, 40])
def test_score_needs_no_space_for_files(folder: Path, limit_bytes: int) -> None:
    # A file-size limit holds for the cache, as a full disk does.
    code = f"""
        import resource
        from tests.bench.data.test_array_cache import EXPECTED, content, indices
        from rebar_depth_bench.data.cache import open_cache
        resource.setrlimit(resource.RLIMIT_FSIZE, ({limit_bytes}, {limit_bytes}))
        cache = open_cache(content())
        assert indices(cache) == EXPECTED and len(cache.numbers) == len(EXPECTED)
    """
    command = [sys.executable, "-B", "-c", textwrap.dedent(code)]
    finished = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert finished.returncode == 0, finished.stderr
    assert len(finished.stderr.splitlines()) == 1
    assert "computed whenever it is needed" in finished.stderr
    assert [*folder.iterdir()] == []


def test_entry_of_read_only_folder_is_used(folder: Path) -> None:
    open_cache(content())
    folder.chmod(0o500)
    try:
        assert indices(open_cache(content(unexpected_extraction))) == EXPECTED
    finally:
        folder.chmod(0o700)


def test_cache_lies_in_home_without_xdg_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for given in ("", "relative"):
        monkeypatch.setenv("XDG_CACHE_HOME", given)
        monkeypatch.setenv("HOME", str(tmp_path / "home"))
        assert cache_folder() == tmp_path / "home" / ".cache" / "rebar-depth-bench"


PROCESS = textwrap.dedent(
    """
    import sys, time
    from tests.bench.data.test_array_cache import EXPECTED, content, indices, views
    from rebar_depth_bench.data.cache import open_cache

    def slow(view_ids):
        for view in views(view_ids):
            print("view", flush=True)
            time.sleep(float(sys.argv[1]))
            yield view

    assert indices(open_cache(content(slow))) == EXPECTED
    """
)


def start_process(delay_s: float) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", PROCESS, str(delay_s)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.slow
@pytest.mark.parametrize("damaged", [False, True])
def test_concurrent_processes_write_the_same_entry(folder: Path, damaged: bool) -> None:
    if damaged:
        open_cache(content())
        flip(only_file(folder), -1)
    processes = [start_process(0.2) for _ in range(3)]
    outputs = [process.communicate() for process in processes]
    for process, (_, errors) in zip(processes, outputs, strict=True):
        assert process.returncode == 0, errors
        assert errors.count("\n") <= int(damaged)  # A process may start when another one is done.
    only_file(folder)
    assert indices(open_cache(content(unexpected_extraction))) == EXPECTED


@pytest.mark.slow
def test_killed_process_leaves_no_usable_entry(folder: Path) -> None:
    process = start_process(60)
    assert process.stdout is not None
    assert process.stdout.readline() == "view\n"
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert only_file(folder).suffix == ".tmp"
    assert indices(open_cache(content())) == EXPECTED
    assert len(entries(folder)) == len(clear(folder)) == 2
