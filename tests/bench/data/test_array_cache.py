"""Tests of the array cache: round trip, repair of damaged files and failed fills."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from rebar_depth_bench.data.array_cache import ViewArrays, open_cache
from rebar_depth_bench.errors import DatasetError

DTYPES = {"index": np.uint32, "inside": np.bool_}


def views(count: int) -> Iterator[ViewArrays]:
    for n in range(count):
        arrays = {"index": np.arange(n) + 10 * n, "inside": np.arange(n) % 2 == 0}
        yield ViewArrays(f"lattice/{n:04}", arrays, {"K": 0.1 * n})


def unexpected_fill() -> Iterator[ViewArrays]:
    raise AssertionError("filled although it is there")


def test_round_trip_fills_cache_once(tmp_path: Path) -> None:
    path = tmp_path / "cache" / "c-1"
    open_cache(path, DTYPES, lambda: views(4), stale_pattern="c-*")
    cache = open_cache(path, DTYPES, unexpected_fill, stale_pattern="c-*")
    cached_views = [cache.view(number) for number in range(len(cache))]
    assert [view.view_id for view in cached_views] == [f"lattice/{n:04}" for n in range(4)]
    for view, expected in zip(cached_views, views(4), strict=True):
        assert view.metadata == expected.metadata
        for name, dtype in DTYPES.items():
            assert view.arrays[name].dtype == dtype
            assert view.arrays[name].tolist() == expected.arrays[name].tolist()


@pytest.mark.parametrize("count", [0, 1])
def test_cache_of_zero_or_one_view_is_reused(tmp_path: Path, count: int) -> None:
    path = tmp_path / "c-1"
    open_cache(path, DTYPES, lambda: views(count), stale_pattern="c-*")
    assert len(open_cache(path, DTYPES, unexpected_fill, stale_pattern="c-*")) == count


@pytest.mark.parametrize("damage", ["views.json", "index", "inside"])
@pytest.mark.parametrize("how", ["cut", "gone", "empty", "longer"])
def test_damaged_cache_is_refilled(tmp_path: Path, damage: str, how: str) -> None:
    path = tmp_path / "c-1"
    open_cache(path, DTYPES, lambda: views(4), stale_pattern="c-*")
    file = path / damage
    content = file.read_bytes()
    if how == "gone":
        file.unlink()
    else:
        file.write_bytes({"cut": content[:-2], "empty": b"", "longer": content + b"1234"}[how])
    cache = open_cache(path, DTYPES, lambda: views(4), stale_pattern="c-*")
    assert [cache.view(number).arrays["index"].tolist() for number in range(4)] == [
        [],
        [10],
        [20, 21],
        [30, 31, 32],
    ]
    assert file.read_bytes() == content


def test_failed_fill_leaves_no_files_and_stale_cache_is_removed(tmp_path: Path) -> None:
    def failing() -> Iterator[ViewArrays]:
        yield from views(2)
        raise KeyError("the dataset is damaged")

    with pytest.raises(KeyError):
        open_cache(tmp_path / "c-1", DTYPES, failing, stale_pattern="c-*")
    assert list(tmp_path.iterdir()) == []
    open_cache(tmp_path / "c-1", DTYPES, lambda: views(2), stale_pattern="c-*")
    open_cache(tmp_path / "d-1", DTYPES, lambda: views(2), stale_pattern="d-*")
    open_cache(tmp_path / "c-2", DTYPES, lambda: views(3), stale_pattern="c-*")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["c-2", "d-1"]


def test_open_cache_is_readable_after_deletion(tmp_path: Path) -> None:
    cache = open_cache(tmp_path / "c-1", DTYPES, lambda: views(4), stale_pattern="c-*")
    shutil.rmtree(tmp_path / "c-1")
    assert cache.view(3).arrays["index"].tolist() == [30, 31, 32]


def test_changed_values_raise_dataset_error(tmp_path: Path) -> None:
    open_cache(tmp_path / "c-1", DTYPES, lambda: views(4), stale_pattern="c-*")
    file = tmp_path / "c-1" / "index"
    content = bytearray(file.read_bytes())
    content[-4] ^= 1
    file.write_bytes(content)
    cache = open_cache(tmp_path / "c-1", DTYPES, unexpected_fill, stale_pattern="c-*")
    assert cache.view(2).arrays["index"].tolist() == [20, 21]
    with pytest.raises(
        DatasetError, match=r"c-1: the cached values of lattice/0003 are damaged; delete this folder"
    ):
        cache.view(3)


@pytest.mark.parametrize(
    "outline", ["[]", "{}", '{"view_ids": ["a"], "starts": [], "checksums": [], "notes": []}', "null", "1"]
)
def test_cache_with_invalid_index_file_is_refilled(tmp_path: Path, outline: str) -> None:
    open_cache(tmp_path / "c-1", DTYPES, lambda: views(2), stale_pattern="c-*")
    (tmp_path / "c-1" / "views.json").write_text(outline)
    assert len(open_cache(tmp_path / "c-1", DTYPES, lambda: views(2), stale_pattern="c-*")) == 2


def test_unwritable_cache_folder_raises_dataset_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(DatasetError, match="the cache of ground truth cannot be written: File exists"):
        open_cache(tmp_path / "file" / "c-1", DTYPES, lambda: views(2), stale_pattern="c-*")
