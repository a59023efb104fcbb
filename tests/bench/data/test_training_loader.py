"""Training batches: shuffling, crops and flips that keep depth, masks, K and poses consistent."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import datasets
import numpy as np
import pytest
from jaxtyping import Float64
from numpy import ndarray

import rebar_depth_bench as rdb
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.data.torch import Augmentation, flip_row

torch = pytest.importorskip("torch")

CROP = (20, 30)
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


@pytest.mark.parametrize("num_workers", [0, 2])
@pytest.mark.parametrize("streaming", [False, True])
def test_crops_and_flips_depend_on_seed_epoch_and_view(tiny_root: Path, num_workers: int, streaming: bool) -> None:
    options = {"crop": CROP, "flip": True, "shuffle": True, "num_workers": num_workers, "streaming": streaming}
    by_view = {batch["view_id"][0]: batch["depth"] for batch in batches(tiny_root, crop=CROP, flip=True)}
    found = batches(tiny_root, **options)
    assert sorted(ids(found)) == sorted(by_view)
    assert all(torch.equal(batch["depth"], by_view[batch["view_id"][0]]) for batch in found)
    assert any(
        not torch.equal(batch["depth"], by_view[batch["view_id"][0]])
        for batch in batches(tiny_root, seed=1, **options)
    )


@pytest.mark.parametrize("streaming", [False, True])
def test_epochs_have_different_orders_and_crops_that_can_be_repeated(tiny_root: Path, streaming: bool) -> None:
    def two_epochs() -> list[list[dict[str, Any]]]:
        loader = rdb.torch_loader(rdb.load(tiny_root, "lattice", streaming=streaming), shuffle=True, crop=CROP)
        return [list(loader), list(loader)]

    first, second = two_epochs()
    again = two_epochs()
    unshuffled = ids(batches(tiny_root))
    assert sorted(ids(first)) == sorted(ids(second)) == sorted(unshuffled)
    assert len({tuple(ids(first)), tuple(ids(second)), tuple(unshuffled)}) == 3
    assert [ids(epoch) for epoch in again] == [ids(first), ids(second)]
    crops = [{batch["view_id"][0]: batch["K"] for batch in epoch} for epoch in (first, second)]
    assert any(not torch.equal(crops[0][view_id], crops[1][view_id]) for view_id in unshuffled)


@pytest.mark.parametrize(
    ("options", "where"), [({"crop": (0, 5)}, "crop"), ({"crop": (5,)}, "crop"), ({"seed": -1}, "seed")]
)
def test_invalid_augmentations_are_refused(options: dict[str, Any], where: str) -> None:
    with pytest.raises(InputError) as caught:
        Augmentation(**options)
    assert [problem.where for problem in caught.value.problems] == [where]


def test_crop_larger_than_the_image_is_refused(tiny_root: Path) -> None:
    with pytest.raises(InputError, match="crop"):
        batches(tiny_root, crop=(10_000, 10))


def test_flip_of_a_pair_that_lacks_an_eye_is_refused(tiny_root: Path) -> None:
    row = dict(rdb.load(tiny_root, "lattice", columns=["view_id", "left_depth", "right_depth"])[0])
    row["right_depth"] = None
    with pytest.raises(InputError, match="one eye only"):
        flip_row(row)


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


def test_other_than_one_split_with_all_columns_is_refused(tiny_root: Path) -> None:
    with pytest.raises(rdb.DatasetError, match=r"DatasetDict, expected one split, as rdb\.load"):
        rdb.torch_loader(datasets.load_dataset(str(tiny_root), "lattice"))
    with pytest.raises(rdb.DatasetError, match=r"lacks the columns left_rgb, .*expected those that rdb\.load"):
        rdb.torch_loader(rdb.load(tiny_root, "lattice", columns=["view_id"]))
