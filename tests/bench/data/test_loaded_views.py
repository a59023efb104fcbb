"""Uses of loaded configs through datasets and DataLoader."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import datasets
import numpy as np
import pyarrow as pa
import pytest
from PIL import Image

import rebar_depth_bench as rdb
from rebar_depth_bench.data.codecs import encode_depth
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.rows import iterate_rows
from rebar_depth_bench.data.schema import COLUMNS
from tests.damage import change_manifest, change_rows, copy_dataset, first_shard

torch = pytest.importorskip("torch")

CONFIG, VIEWS = "lattice", 9
USED = ["view_id", "left_rgb", "left_depth", "left_mask", "left_bars", "left_K", "baseline_m"]
TYPES = {"left_rgb": np.uint8, "left_depth": np.float32, "left_mask": np.bool_, "left_bars": np.uint16}
Rows = Iterable[Mapping[str, Any]]


def mean(row: Mapping[str, Any]) -> dict[str, float]:
    return {"mean": float(np.mean(np.asarray(row["left_depth"])))}


def halves(row: Mapping[str, Any]) -> dict[str, Any]:
    return {"left_rgb": np.asarray(row["left_rgb"])[::2, ::2], "left_bars": np.asarray(row["left_bars"])[::2, ::2]}


def is_near(row: Mapping[str, Any]) -> bool:
    return bool(np.asarray(row["left_depth"]).min() >= 0)


def brighten(batch: dict[str, Any]) -> dict[str, Any]:
    return batch | {"left_rgb": [np.minimum(np.asarray(image), 254) + 1 for image in batch["left_rgb"]]}


def loader_views(ds: Any, **options: Any) -> Iterator[Mapping[str, Any]]:
    """Yield the views of the batches of a ``DataLoader`` with its own collate function."""
    for batch in torch.utils.data.DataLoader(ds, batch_size=3, **options):
        for index, view_id in enumerate(batch["view_id"]):
            yield {name: column[index] for name, column in batch.items()} | {"view_id": view_id}


def saved(ds: Any, folder: Path) -> Any:
    ds.save_to_disk(folder)
    return datasets.load_from_disk(folder)


BOTH: dict[str, Callable[[Any], Rows]] = {
    "plain": lambda ds: ds,
    "torch": lambda ds: ds.with_format("torch"),
    "numpy": lambda ds: ds.with_format("numpy"),
    "None": lambda ds: ds.with_format(None),
    "map": lambda ds: ds.map(mean),
    "map that changes": lambda ds: ds.map(halves),
    "batched map": lambda ds: ds.map(brighten, batched=True),
    "filter": lambda ds: ds.filter(is_near),
    "shuffle": lambda ds: ds.shuffle(seed=1),
    "rename_column": lambda ds: ds.rename_column("left_depth", "z"),
    "remove_columns": lambda ds: ds.remove_columns(["left_bars"]),
    "add_column": lambda ds: ds.add_column("n", list(range(VIEWS))),
    "take and skip": lambda ds: ds.skip(1).take(5),
    "concatenate_datasets": lambda ds: datasets.concatenate_datasets([ds, ds]),
    "pickle": lambda ds: pickle.loads(pickle.dumps(ds)),
    "DataLoader": loader_views,
    "DataLoader, workers": lambda ds: loader_views(ds, num_workers=2),
    "DataLoader of torch": lambda ds: loader_views(ds.with_format("torch")),
}
MAP_STYLE: dict[str, Callable[[Any, Path], Rows]] = {
    "index": lambda ds, _: [ds[index] for index in range(VIEWS)],
    "slice": lambda ds, _: [dict(zip(ds[:2], cells, strict=True)) for cells in zip(*ds[:2].values(), strict=True)],
    "column": lambda ds, _: [{"left_rgb": cell} for cell in ds["left_rgb"]],
    "select": lambda ds, _: ds.select([3, 1]),
    "set_format": lambda ds, _: ds.set_format("torch") or ds,
    "with_transform": lambda ds, _: ds.with_transform(brighten),
    "to_iterable_dataset": lambda ds, _: ds.to_iterable_dataset(num_shards=2),
    "map, workers": lambda ds, _: ds.map(mean, num_proc=2),
    "save_to_disk": lambda ds, folder: saved(ds, folder),
    "save_to_disk of torch": lambda ds, folder: saved(ds.with_format("torch"), folder),
    "save_to_disk of a selection": lambda ds, folder: saved(ds.select([3, 1]), folder),
    "concatenation with saved": lambda ds, folder: datasets.concatenate_datasets([ds, saved(ds, folder)]),
    "to_parquet": lambda ds, folder: (
        ds.to_parquet(folder / "a.parquet")
        and datasets.load_dataset("parquet", data_files=str(folder / "a.parquet"), split="train")
    ),
}


CHANGES: dict[str, Callable[[Mapping[str, Any]], dict[str, Any]]] = {
    "map that changes": halves,
    "batched map": lambda row: {"left_rgb": np.minimum(row["left_rgb"], 254) + 1},
    "with_transform": lambda row: {"left_rgb": np.minimum(row["left_rgb"], 254) + 1},
}
"""Changed columns of a row."""


def check(row: Mapping[str, Any], truth: Mapping[str, Any] | None, *, is_wide: bool) -> None:
    """Compare the images of a row with ``truth``, whatever holds them; ``is_wide``: integers may be int64."""
    for name, cell in row.items():
        assert not isinstance(cell, (bytes, dict)), f"{name} is {type(cell)}"
        column = "left_depth" if name == "z" else name
        if column not in TYPES:
            continue
        assert isinstance(cell, (torch.Tensor, np.ndarray, Image.Image)), f"{name} is {type(cell)}"
        array = np.asarray(cell)
        assert array.dtype == TYPES[column] or (is_wide and array.dtype == np.int64), name
        if truth is not None:
            expected = truth[column]
            is_planes = array.ndim == 3 and array.shape[-1] != 3
            assert np.array_equal((array.transpose(1, 2, 0) if is_planes else array).squeeze(), expected), name


@pytest.fixture(scope="module")
def truth(tiny_root: Path) -> dict[str, dict[str, Any]]:
    config = open_folder(tiny_root).config(CONFIG)
    return {row["view_id"]: row for row in iterate_rows(config, USED)}


@pytest.mark.slow
@pytest.mark.parametrize("streaming", [False, True])
@pytest.mark.parametrize("use", BOTH)
def test_use_of_both_kinds_gives_images(
    tiny_root: Path, truth: dict[str, dict[str, Any]], use: str, streaming: bool
) -> None:
    rows = list(BOTH[use](rdb.load(tiny_root, CONFIG, streaming=streaming, columns=USED)))
    assert len(rows) >= (5 if use == "take and skip" else VIEWS)
    for row in rows:
        view = truth[str(row["view_id"])]
        check(row, view | CHANGES.get(use, dict)(view), is_wide=streaming)


@pytest.mark.slow
@pytest.mark.parametrize("use", MAP_STYLE)
def test_use_of_a_map_style_dataset_gives_images(
    tiny_root: Path, tmp_path: Path, truth: dict[str, dict[str, Any]], use: str
) -> None:
    rows = list(MAP_STYLE[use](rdb.load(tiny_root, CONFIG, columns=USED), tmp_path))
    assert rows
    for row in rows:
        view = truth[str(row["view_id"])] if "view_id" in row else None
        check(row, view and view | CHANGES.get(use, dict)(view), is_wide=False)


@pytest.mark.parametrize("streaming", [False, True])
def test_arrays_of_rows_are_exact_and_writable(tiny_root: Path, streaming: bool) -> None:
    expected_rows = iterate_rows(open_folder(tiny_root).config(CONFIG), COLUMNS)
    for row, expected in zip(rdb.load(tiny_root, CONFIG, streaming=streaming), expected_rows, strict=True):
        assert list(row) == list(expected)
        assert type(row["view_id"]) is str
        assert isinstance(row["baseline_m"], float)
        for name, cell in expected.items():
            assert np.array_equal(row[name], cell), name
            if isinstance(cell, np.ndarray):
                assert row[name].dtype == cell.dtype, name
                assert row[name].flags.writeable, name


def test_streamed_configs_of_several_sizes_are_concatenated(tiny_root: Path, tmp_path: Path) -> None:
    root, other = copy_dataset(tiny_root, tmp_path / "copy"), "lattice-orbit"
    change_manifest(root, lambda _, config: config["rig"].update(width=80, height=45), other)
    small = encode_depth(np.ones((45, 80), np.float32))
    change_rows(first_shard(root, other), lambda rows: [row.update(left_depth=small) for row in rows])
    configs = [rdb.load(root, name, columns=["left_depth"], streaming=True) for name in (CONFIG, other)]
    both = datasets.concatenate_datasets(configs)
    assert [row["left_depth"].shape for row in both] == [(90, 160)] * VIEWS + [(45, 80)] * 2
    change_rows(first_shard(root, other), lambda rows: rows[1].update(left_depth=small[:-20]))
    with pytest.raises(rdb.DatasetError, match="view lattice-orbit/0075: left_depth is damaged"):
        list(both)


def test_loaded_table_stays_on_disk(tiny_root: Path) -> None:
    before = pa.total_allocated_bytes()
    ds = rdb.load(tiny_root, CONFIG)
    assert ds.features["left_depth"] == datasets.Image(mode="F")
    assert ds.features["left_rgb"] == datasets.Image()
    assert pa.total_allocated_bytes() - before < ds.data.nbytes / 100
    assert len(pickle.dumps(ds)) < ds.data.nbytes / 10
