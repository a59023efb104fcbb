"""Training batches."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import datasets
import numpy as np
import pytest
from jaxtyping import Float64
from numpy import ndarray

import rebar_depth_bench as rdb
from rebar_depth_bench.base.errors import InputError
from tests.synthetic_dataset import write_split_dataset

torch = pytest.importorskip("torch")

from rebar_depth_bench.data.torch import flip_row  # noqa: E402

CROP = (20, 30)
CONFIG, VIEWS = "lattice", 9
EYES = {"": "left", "right_": "right"}


def batches(root: Path, **options: Any) -> list[dict[str, Any]]:
    return list(rdb.torch_loader(rdb.load(root, "lattice", streaming=options.pop("streaming", False)), **options))


def ids(found: list[dict[str, Any]]) -> list[str]:
    return [view_id for batch in found for view_id in batch["view_id"]]


def depth_by_view(epoch: Any) -> dict[str, Any]:
    return {
        view_id: depth for batch in epoch for view_id, depth in zip(batch["view_id"], batch["depth"], strict=True)
    }


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
def test_order_crops_and_flips_depend_on_seed_draws_and_view(
    tiny_root: Path, num_workers: int, streaming: bool
) -> None:
    def two_epochs(torch_seed: int = 3, **options: Any) -> list[list[dict[str, Any]]]:
        views = rdb.load(tiny_root, "lattice", streaming=streaming)
        loader = rdb.torch_loader(views, num_workers=num_workers, crop=CROP, flip=True, **options)
        torch.manual_seed(torch_seed)
        return [list(loader), list(loader)]

    first, second = two_epochs(shuffle=True)
    again = two_epochs(shuffle=True)
    other_torch_seed = two_epochs(4, shuffle=True)
    [unshuffled, _], [other_seed, _] = two_epochs(), two_epochs(seed=1)
    assert len({tuple(ids(epoch)) for epoch in (first, second, unshuffled)}) == 3
    assert [ids(epoch) for epoch in again] == [ids(first), ids(second)]
    assert (ids(other_torch_seed[0]) != ids(first)) == streaming
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
    with pytest.raises(InputError, match="crop"):
        batches(tiny_root, crop=(10_000, 10))
    row = dict(rdb.load(tiny_root, "lattice", columns=["view_id", "left_depth", "right_depth"])[0])
    row["right_depth"] = None
    with pytest.raises(InputError, match="one eye only"):
        flip_row(row)


@pytest.mark.parametrize("streaming", [False, True])
@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("batch_size", [None, 0, -1, 2.0, True, "2", [2]]),
        ("num_workers", [None, -1, 1.0, "1"]),
        ("crop", [0, -8, 64.0, True, "64", (8.0, 8), (8, None), (0, 8), (8,), (8, 8, 8), {8, 9}]),
        ("seed", [None, -1, 1.5, "1"]),
        ("flip", [None, 0.5, "no"]),
        ("shuffle", [None, "no"]),
        ("stereo", [None, "right"]),
        ("drop_last", ["no"]),
        ("pin_memory", ["cuda"]),
        ("sampler", [3, 0.5]),
    ],
)
def test_wrong_arguments_are_named(tiny_root: Path, streaming: bool, name: str, values: list[Any]) -> None:
    views = rdb.load(tiny_root, CONFIG, streaming=streaming)
    for value in values:
        with pytest.raises(InputError) as caught:
            rdb.torch_loader(views, **{name: value})
        assert [problem.where for problem in caught.value.problems] == [name]
        assert repr(value) in caught.value.problems[0].found


def test_one_side_is_a_square_crop(tiny_root: Path) -> None:
    expected = depth_by_view(batches(tiny_root, crop=(24, 24)))
    for side in (24, np.int64(24)):
        found = depth_by_view(batches(tiny_root, batch_size=np.int32(1), crop=side))
        assert all(torch.equal(depth, expected[view_id]) for view_id, depth in found.items())


def test_samplers_choose_the_rows_and_their_order(tiny_root: Path) -> None:
    all_ids = ids(batches(tiny_root))
    for numbers in ([5, 0, 5], np.array([5, 0, 5]), torch.tensor([5, 0, 5])):
        assert ids(batches(tiny_root, sampler=numbers)) == [all_ids[5], all_ids[0], all_ids[5]]
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


@pytest.mark.slow
@pytest.mark.parametrize("copied", [lambda source: source, copy.deepcopy])
@pytest.mark.parametrize("streaming", [False, True])
def test_frameworks_build_the_loader_again(tiny_root: Path, streaming: bool, copied: Callable[[Any], Any]) -> None:
    def loader() -> Any:
        views = rdb.load(tiny_root, CONFIG, streaming=streaming)
        return rdb.torch_loader(views, 2, crop=CROP, flip=True, seed=4)

    original = loader()
    assert type(original) is torch.utils.data.DataLoader
    expected = [depth_by_view(original) for _ in range(3)]
    assert any(not torch.equal(depth, expected[1][view_id]) for view_id, depth in expected[0].items())
    for workers in ({}, {"num_workers": 2}, {"num_workers": 2, "persistent_workers": True}):
        given = loader()
        sampler = None if streaming else range(len(given.dataset))[::-1]
        again = torch.utils.data.DataLoader(
            copied(given.dataset), 3, sampler=sampler, collate_fn=given.collate_fn, **workers
        )
        for depths in expected:
            found = depth_by_view(again)
            assert found.keys() == depths.keys()
            assert all(torch.equal(depth, depths[view_id]) for view_id, depth in found.items())


def test_view_drawn_twice_in_an_epoch_is_changed_twice(tiny_root: Path) -> None:
    twice, once = (
        rdb.torch_loader(rdb.load(tiny_root, CONFIG), crop=CROP, seed=4, sampler=sampler)
        for sampler in ([1, 0, 1], [1])
    )
    first, _, second = twice
    for batch in (first, second):
        [same] = once
        assert torch.equal(batch["depth"], same["depth"])
    assert not torch.equal(first["depth"], second["depth"])


@pytest.mark.slow
def test_shuffled_loader_is_sent_to_spawned_processes(tiny_root: Path) -> None:
    loader = rdb.torch_loader(rdb.load(tiny_root, CONFIG), shuffle=True, crop=CROP)
    torch.multiprocessing.spawn(_expect_batches, (loader, len(loader)))


def _expect_batches(_: int, loader: Any, expected: int) -> None:
    assert len(list(loader)) == expected


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
