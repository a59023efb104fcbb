"""Training batches of a config of several scenes: shards of the loader's workers, and their order."""

from __future__ import annotations

from pathlib import Path

import pytest

import rebar_depth_bench as rdb
from tests.synthetic_dataset import write_split_dataset

pytest.importorskip("torch")

SCENES = {"a": "train", "b": "train", "c": "train", "d": "validation"}
VIEWS = 4


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cages") / "dataset"
    write_split_dataset(folder, SCENES, VIEWS)
    return folder


def epochs(root: Path, count: int, *, streaming: bool, shuffle: bool, num_workers: int) -> list[list[str]]:
    """Return the view ids in the order of the batches of ``count`` epochs, without their split."""
    views = rdb.load(root, "cages", split="train", streaming=streaming)
    loader = rdb.torch_loader(views, 2, num_workers, shuffle=shuffle, crop=(32, 32), flip=True)
    return [
        [view_id.removeprefix("cages/train-") for batch in loader for view_id in batch["view_id"]]
        for _ in range(count)
    ]


ALL = sorted(f"{scene}-{index:04d}" for scene in "abc" for index in range(VIEWS))


@pytest.mark.parametrize("num_workers", [0, 2])
@pytest.mark.parametrize("shuffle", [False, True])
@pytest.mark.parametrize("streaming", [False, True])
def test_workers_load_each_view_once(root: Path, streaming: bool, shuffle: bool, num_workers: int) -> None:
    first, second = epochs(root, 2, streaming=streaming, shuffle=shuffle, num_workers=num_workers)
    assert sorted(first) == sorted(second) == ALL
    assert (first != second) == shuffle


def test_streamed_shards_are_divided_among_workers(root: Path) -> None:
    """Batches come from the workers in turn: scenes a and c from the first one, b from the second one."""
    [found] = epochs(root, 1, streaming=True, shuffle=False, num_workers=2)
    scenes = [f"{first[0]}{second[0]}" for first, second in zip(found[::2], found[1::2], strict=True)]
    assert scenes == ["aa", "bb", "aa", "bb", "cc", "cc"]


def test_streamed_scenes_have_another_order_in_each_epoch(root: Path) -> None:
    found = epochs(root, 8, streaming=True, shuffle=True, num_workers=0)
    assert len({epoch[0][0] for epoch in found}) > 1


def test_more_workers_than_scenes_load_each_view_once(root: Path) -> None:
    views = rdb.load(root, "cages", split="validation", streaming=True)
    found = [batch["view_id"][0] for batch in rdb.torch_loader(views, 1, 2, shuffle=True)]
    assert sorted(found) == [f"cages/validation-d-{index:04d}" for index in range(VIEWS)]
