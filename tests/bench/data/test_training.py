"""Training batches, and uses of loaded configs through datasets and DataLoader."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import datasets
import numpy as np
import pyarrow as pa
import pytest
from jaxtyping import Float64
from numpy import ndarray
from PIL import Image

import rebar_depth_bench as rdb
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.rows import iterate_rows
from rebar_depth_bench.data.schema import COLUMNS
from rebar_depth_bench.data.torch import Augmentation, flip_row
from tests.synthetic_dataset import write_split_dataset

torch = pytest.importorskip("torch")

CROP = (20, 30)
CONFIG, VIEWS = "lattice", 9
EYES = {"": "left", "right_": "right"}


def batches(root: Path, **options: Any) -> list[dict[str, Any]]:
    return list(rdb.torch_loader(rdb.load(root, "lattice", streaming=options.pop("streaming", False)), **options))


def ids(found: list[dict[str, Any]]) -> list[str]:
    return [view_id for batch in found for view_id in batch["view_id"]]


def project(K: ndarray, cam_from_world: ndarray, points_m: ndarray) -> Float64[ndarray, "n 3"]:
    """Return u, v in pixels and the depth in metres of world points."""
    cam_m = points_m @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
    uvw = cam_m @ K.T
    return np.concatenate([uvw[:, :2] / uvw[:, 2:], cam_m[:, 2:]], axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("options", [{"crop": CROP}, {"flip": True}, {"crop": CROP, "flip": True}])
def test_points_of_the_world_are_seen_where_they_are_projected(tiny_root: Path, options: dict[str, Any]) -> None:
    original = {row["view_id"]: row for row in rdb.load(tiny_root, "lattice")}
    flipped = 0
    for batch in batches(tiny_root, stereo=True, seed=5, **options):
        row = original[batch["view_id"][0]]
        flipped += np.linalg.det(batch["poses"][0].numpy()[:3, :3]) < 0
        for prefix in EYES:
            image = {kind: batch[f"{prefix}{kind}"][0].numpy() for kind in ("rgb", "depth", "mask", "K", "poses")}
            assert image["depth"].shape == (1, *options.get("crop", row["left_depth"].shape))
            is_mirrored = np.linalg.det(image["poses"][:3, :3]) < 0
            eye = {"": "left", "right_": "right"}["right_" if is_mirrored == (prefix == "") else ""]
            height, width = row[f"{eye}_depth"].shape
            v, u = np.mgrid[:height, :width].reshape(2, -1)
            depth_m = row[f"{eye}_depth"][v, u].astype(float)
            seen = depth_m > 0
            v, u, depth_m = v[seen], u[seen], depth_m[seen]
            K, pose = row[f"{eye}_K"], row[f"{eye}_cam_from_world"]
            cam_m = np.stack([u, v, np.ones(len(u))], axis=1) * depth_m[:, None] @ np.linalg.inv(K).T
            world_m = (cam_m - pose[:3, 3]) @ pose[:3, :3]
            found = project(image["K"], image["poses"], world_m)
            pixel = np.round(found[:, :2]).astype(int)
            assert np.abs(found[:, :2] - pixel).max() < 1e-6
            inside = ((pixel >= 0) & (pixel < image["depth"].shape[:0:-1])).all(axis=1)
            assert inside.sum() == (image["depth"] > 0).sum() > 0
            at = (pixel[inside, 1], pixel[inside, 0])
            np.testing.assert_allclose(image["depth"][0][at], found[inside, 2], rtol=1e-6)
            assert np.array_equal(image["mask"][0][at], row[f"{eye}_mask"][v, u][inside])
            assert np.array_equal(image["rgb"][:, *at].T, row[f"{eye}_rgb"][v, u][inside])
        centres_m = [np.linalg.inv(batch[f"{prefix}poses"][0].numpy()) for prefix in EYES]
        right_in_left_m = batch["poses"][0].numpy() @ centres_m[1][:, 3]
        np.testing.assert_allclose(right_in_left_m[:3], [batch["baseline_m"][0], 0, 0], atol=1e-9)
    assert (0 < flipped < len(original)) if options.get("flip") else flipped == 0


def test_single_view_is_mirrored_in_place(tiny_root: Path) -> None:
    rows = rdb.load(tiny_root, "lattice", columns=["view_id", "left_depth", "left_K"])
    row = rows[0]
    mirrored = flip_row(row)
    assert np.array_equal(mirrored["left_depth"], np.fliplr(row["left_depth"]))
    assert np.array_equal(flip_row(mirrored)["left_K"], row["left_K"])


@pytest.mark.slow
@pytest.mark.parametrize("num_workers", [0, 2])
@pytest.mark.parametrize("streaming", [False, True])
def test_order_crops_and_flips_depend_on_seed_epoch_and_view(
    tiny_root: Path, num_workers: int, streaming: bool
) -> None:
    def two_epochs(**options: Any) -> list[list[dict[str, Any]]]:
        views = rdb.load(tiny_root, "lattice", streaming=streaming)
        loader = rdb.torch_loader(views, num_workers=num_workers, crop=CROP, flip=True, **options)
        return [list(loader), list(loader)]

    def depth_by_view(epoch: list[dict[str, Any]]) -> dict[str, Any]:
        return {batch["view_id"][0]: batch["depth"] for batch in epoch}

    first, second = two_epochs(shuffle=True)
    again = two_epochs(shuffle=True)
    [unshuffled, _], [other_seed, _] = two_epochs(), two_epochs(seed=1)
    assert len({tuple(ids(epoch)) for epoch in (first, second, unshuffled)}) == 3
    assert [ids(epoch) for epoch in again] == [ids(first), ids(second)]
    expected = depth_by_view(unshuffled)
    for epoch, is_same in ((first, True), (again[0], True), (second, False), (other_seed, False)):
        found = depth_by_view(epoch)
        assert sorted(found) == sorted(expected)
        assert all(torch.equal(found[view_id], expected[view_id]) for view_id in expected) == is_same


@pytest.mark.slow
@pytest.mark.parametrize("streaming", [False, True])
def test_plain_and_saved_datasets_give_the_same_batches(tiny_root: Path, tmp_path: Path, streaming: bool) -> None:
    options: dict[str, Any] = {"stereo": True, "crop": CROP, "flip": True, "seed": 3}
    expected = batches(tiny_root, **options)
    sources = [datasets.load_dataset(str(tiny_root), "lattice", split="test", streaming=streaming)]
    if not streaming:
        rdb.load(tiny_root, "lattice").save_to_disk(tmp_path)
        sources += [datasets.load_from_disk(tmp_path), rdb.load(tiny_root, "lattice").with_format("torch")]
    for source in sources:
        for batch, same in zip(rdb.torch_loader(source, **options), expected, strict=True):
            assert list(batch) == list(same)
            for key, value in batch.items():
                assert value == same[key] if key == "view_id" else torch.equal(value, same[key]), key


def test_transform_is_applied_to_batches(tiny_root: Path) -> None:
    ds = rdb.load(tiny_root, "lattice").with_transform(
        lambda rows: rows | {"left_mask": [np.ones_like(image) for image in rows["left_mask"]]}
    )
    assert all(batch["mask"].all() for batch in rdb.torch_loader(ds))


def test_what_cannot_be_batched_is_refused(tiny_root: Path) -> None:
    with pytest.raises(rdb.DatasetError, match=r"DatasetDict, expected one split, as rdb\.load"):
        rdb.torch_loader(datasets.load_dataset(str(tiny_root), "lattice"))
    with pytest.raises(rdb.DatasetError, match=r"lacks the columns left_rgb, .*expected those that rdb\.load"):
        rdb.torch_loader(rdb.load(tiny_root, "lattice", columns=["view_id"]))
    invalid: list[tuple[dict[str, Any], str]] = [
        ({"crop": (0, 5)}, "crop"),
        ({"crop": (5,)}, "crop"),
        ({"seed": -1}, "seed"),
    ]
    for options, where in invalid:
        with pytest.raises(InputError) as caught:
            Augmentation(**options)
        assert [problem.where for problem in caught.value.problems] == [where]
    with pytest.raises(InputError, match="crop"):
        batches(tiny_root, crop=(10_000, 10))
    row = dict(rdb.load(tiny_root, "lattice", columns=["view_id", "left_depth", "right_depth"])[0])
    row["right_depth"] = None
    with pytest.raises(InputError, match="one eye only"):
        flip_row(row)


def test_samplers_choose_the_rows_and_their_order(tiny_root: Path) -> None:
    all_ids = ids(batches(tiny_root))
    assert ids(batches(tiny_root, sampler=[5, 0, 5])) == [all_ids[5], all_ids[0], all_ids[5]]
    ranks = [
        ids(batches(tiny_root, sampler=torch.utils.data.DistributedSampler(all_ids, 3, rank, shuffle=True)))
        for rank in range(3)
    ]
    assert sorted(view_id for found in ranks for view_id in found) == all_ids
    assert [len(batch["view_id"]) for batch in batches(tiny_root, batch_size=4, drop_last=True)] == [4, 4]
    assert rdb.torch_loader(rdb.load(tiny_root, CONFIG), pin_memory=True).pin_memory
    with pytest.raises(InputError, match="sampler is given with shuffle, expected only one"):
        batches(tiny_root, sampler=[0], shuffle=True)
    with pytest.raises(InputError, match="sampler is given with a streamed dataset"):
        batches(tiny_root, sampler=[0], streaming=True)


def test_batch_has_the_values_of_the_rows(tiny_root: Path) -> None:
    [batch] = batches(tiny_root, batch_size=VIEWS, stereo=True)
    types = {
        "rgb": torch.uint8,
        "depth": torch.float32,
        "mask": torch.bool,
        "K": torch.float64,
        "poses": torch.float64,
    }
    assert {key: batch[key].dtype for key in types} == types
    for position, row in enumerate(rdb.load(tiny_root, "lattice")):
        assert batch["view_id"][position] == row["view_id"]
        assert batch["baseline_m"][position] == row["baseline_m"] == 0.12
        for prefix, eye in EYES.items():
            values = {key: batch[f"{prefix}{key}"][position].numpy() for key in types}
            assert np.array_equal(values["rgb"], row[f"{eye}_rgb"].transpose(2, 0, 1))
            assert np.array_equal(values["depth"], row[f"{eye}_depth"][None])
            assert np.array_equal(values["mask"], row[f"{eye}_mask"][None])
            assert np.array_equal(values["K"], row[f"{eye}_K"])
            assert np.array_equal(values["poses"], row[f"{eye}_cam_from_world"])


SCENES = {"a": "train", "b": "train", "c": "train", "d": "validation"}
SCENE_VIEWS = 4


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cages") / "dataset"
    write_split_dataset(folder, SCENES, SCENE_VIEWS)
    return folder


def epochs(root: Path, count: int, *, streaming: bool, shuffle: bool, num_workers: int) -> list[list[str]]:
    """Return the view ids in the order of the batches of ``count`` epochs, without their split."""
    views = rdb.load(root, "cages", split="train", streaming=streaming)
    loader = rdb.torch_loader(views, 2, num_workers, shuffle=shuffle, crop=(32, 32), flip=True)
    return [
        [view_id.removeprefix("cages/train-") for batch in loader for view_id in batch["view_id"]]
        for _ in range(count)
    ]


@pytest.mark.slow
@pytest.mark.parametrize("num_workers", [0, 2])
@pytest.mark.parametrize("shuffle", [False, True])
@pytest.mark.parametrize("streaming", [False, True])
def test_workers_load_each_view_once(root: Path, streaming: bool, shuffle: bool, num_workers: int) -> None:
    first, second = epochs(root, 2, streaming=streaming, shuffle=shuffle, num_workers=num_workers)
    every_view = sorted(f"{scene}-{n:04d}" for scene in "abc" for n in range(SCENE_VIEWS))
    assert sorted(first) == sorted(second) == every_view
    assert (first != second) == shuffle


@pytest.mark.slow
def test_streamed_shards_are_divided_among_workers(root: Path) -> None:
    """Batches come from the workers in turn: scenes a and c from the first one, b from the second one."""
    [found] = epochs(root, 1, streaming=True, shuffle=False, num_workers=2)
    scenes = [f"{first[0]}{second[0]}" for first, second in zip(found[::2], found[1::2], strict=True)]
    assert scenes == ["aa", "bb", "aa", "bb", "cc", "cc"]


@pytest.mark.slow
def test_streamed_scenes_have_another_order_in_each_epoch(root: Path) -> None:
    found = epochs(root, 8, streaming=True, shuffle=True, num_workers=0)
    assert len({epoch[0][0] for epoch in found}) > 1


@pytest.mark.slow
def test_more_workers_than_scenes_load_each_view_once(root: Path) -> None:
    views = rdb.load(root, "cages", split="validation", streaming=True)
    found = [batch["view_id"][0] for batch in rdb.torch_loader(views, 1, 2, shuffle=True)]
    assert sorted(found) == [f"cages/validation-d-{index:04d}" for index in range(SCENE_VIEWS)]


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
    "map of None": lambda ds: ds.with_format(None).map(mean),
    "map that changes": lambda ds: ds.map(halves),
    "batched map": lambda ds: ds.map(brighten, batched=True),
    "filter": lambda ds: ds.filter(is_near),
    "shuffle": lambda ds: ds.shuffle(seed=1),
    "rename_column": lambda ds: ds.rename_column("left_depth", "z"),
    "remove_columns": lambda ds: ds.remove_columns(["left_bars"]),
    "select_columns": lambda ds: ds.select_columns(["view_id", "left_depth", "left_K"]),
    "add_column": lambda ds: ds.add_column("n", list(range(VIEWS))),
    "take and skip": lambda ds: ds.skip(1).take(5),
    "repeat": lambda ds: ds.repeat(2),
    "shard": lambda ds: ds.shard(1, 0),
    "concatenate_datasets": lambda ds: datasets.concatenate_datasets([ds, ds]),
    "interleave_datasets": lambda ds: datasets.interleave_datasets([ds, ds]),
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
    "train_test_split": lambda ds, _: ds.train_test_split(test_size=3, seed=0)["train"],
    "set_format": lambda ds, _: ds.set_format("torch") or ds,
    "with_transform": lambda ds, _: ds.with_transform(brighten),
    "to_iterable_dataset": lambda ds, _: ds.to_iterable_dataset(num_shards=2),
    "flatten_indices": lambda ds, _: ds.select([3, 1]).flatten_indices(),
    "map, workers": lambda ds, _: ds.map(mean, num_proc=2),
    "map, cached": lambda ds, _: ds.map(mean) and ds.map(mean),
    "save_to_disk": lambda ds, folder: saved(ds, folder),
    "save_to_disk of torch": lambda ds, folder: saved(ds.with_format("torch"), folder),
    "save_to_disk of None": lambda ds, folder: saved(ds.with_format(None), folder),
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


def test_loaded_table_stays_on_disk(tiny_root: Path) -> None:
    before = pa.total_allocated_bytes()
    ds = rdb.load(tiny_root, CONFIG)
    assert ds.features["left_depth"] == datasets.Image(mode="F")
    assert ds.features["left_rgb"] == datasets.Image()
    assert pa.total_allocated_bytes() - before < ds.data.nbytes / 100
    assert len(pickle.dumps(ds)) < ds.data.nbytes / 10
