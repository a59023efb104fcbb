"""PyTorch data loader for a loaded config; importing it requires torch."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from datasets import Dataset, IterableDataset

from rebar_depth_bench.data.augmentation import Augmentation
from rebar_depth_bench.errors import MethodError

try:
    import torch
    from torch.utils.data import DataLoader
    from torch.utils.data import IterableDataset as TorchIterableDataset
except ImportError as error:
    raise MethodError(f"torch_loader needs torch ({error}): pip install 'rebar-depth-bench[torch]'") from None

Batch = dict[str, Any]

_LEFT = {
    "rgb": "left_rgb",
    "depth": "left_depth",
    "mask": "left_mask",
    "K": "left_K",
    "poses": "left_cam_from_world",
}
SHUFFLE_BUFFER = 32
"""Views of a streamed dataset among which the next one is drawn."""
_RIGHT = {f"right_{key}": column.replace("left", "right") for key, column in _LEFT.items()}


def torch_loader(
    ds: Dataset | IterableDataset,
    batch_size: int = 1,
    num_workers: int = 0,
    *,
    shuffle: bool = False,
    stereo: bool = False,
    crop: tuple[int, int] | None = None,
    flip: bool = False,
    seed: int = 0,
) -> DataLoader[Batch]:
    """Return a ``DataLoader`` over a dataset returned by ``load``, streaming or not.

    A batch is a dict: ``rgb`` uint8 B x 3 x H x W, ``depth`` float32 B x 1 x H x W (planar, metres, 0 where there
    is no surface), ``mask`` bool B x 1 x H x W, ``K`` float64 B x 3 x 3 (pixels), ``poses`` float64 B x 4 x 4
    (``cam_from_world``), all of the left view, and ``view_id``, a list of str. With ``stereo`` the batch also has
    the same keys of the right view, prefixed ``right_``, and ``baseline_m`` float64 B. Batches of a config without
    colour lack ``rgb`` and ``right_rgb``, and those of an imported config all that it lacks.

    Columns that a batch does not need are not decoded, except in a streamed dataset, whose columns are already
    decoded; pass ``columns`` to ``load`` to select them.

    For training, ``shuffle`` changes the order in every epoch. A streamed dataset is shuffled by shard, and then
    in a buffer of 32 views (``SHUFFLE_BUFFER``). ``crop`` (height, width) takes a random part of each view, and
    ``flip`` mirrors half of the views. Depth, masks, K and poses stay consistent: a flipped stereo pair has its
    eyes exchanged, and the pose of a flipped view contains the reflection. The order of shuffled views depends on
    ``seed`` and the epoch, and for a streamed dataset on the number of workers; crops and flips depend on
    ``seed``, the epoch and the view id.

    Importing this module without torch raises ``MethodError``. Raises ``InputError`` for an invalid crop or seed.
    """
    keys = {**_LEFT, **_RIGHT, "baseline_m": "baseline_m"} if stereo else _LEFT
    rows = ds.select_columns(["view_id", *keys.values()])
    collate = _Collate(keys, Augmentation(crop, flip, seed))
    if not isinstance(rows, IterableDataset):
        return _EpochLoader(rows, batch_size, shuffle, collate, num_workers)
    shuffled = rows.shuffle(seed, buffer_size=SHUFFLE_BUFFER) if shuffle else rows
    return _EpochLoader(_StreamedRows(shuffled), batch_size, False, collate, num_workers)


class _EpochLoader(DataLoader[Any]):
    """Data loader that counts its iterations, on which the order, crops and flips depend."""

    def __init__(
        self, source: Dataset | _StreamedRows, batch_size: int, shuffle: bool, collate: _Collate, num_workers: int
    ) -> None:
        super().__init__(
            source,
            batch_size=batch_size,
            shuffle=shuffle,
            collate_fn=collate,
            num_workers=num_workers,
            generator=torch.Generator(),
        )
        self._collate = collate
        self._rows = source.rows if isinstance(source, _StreamedRows) else None

    def __iter__(self) -> Any:
        self._collate.epoch += 1
        self.generator.manual_seed(self._collate.augmentation.seed + self._collate.epoch)
        if self._rows is not None:
            self._rows.set_epoch(self._collate.epoch)
        return super().__iter__()


class _Collate:
    """Collate function that changes decoded rows and stacks them into tensors; it is pickled for workers."""

    def __init__(self, keys: Mapping[str, str], augmentation: Augmentation) -> None:
        self._keys = keys
        self.augmentation = augmentation
        self.epoch = -1

    def __call__(self, rows: Sequence[Mapping[str, Any]]) -> Batch:
        rows = [self.augmentation(row, self.epoch) for row in rows]
        batch: Batch = {
            key: _tensor(key, np.stack([np.asarray(row[column]) for row in rows]))
            for key, column in self._keys.items()
            if rows[0][column] is not None
        }
        batch["view_id"] = [row["view_id"] for row in rows]
        return batch


def _tensor(key: str, stacked: np.ndarray[Any, Any]) -> torch.Tensor:
    """Convert a stacked array to a tensor, with a channel axis for depth and masks.

    Colour is permuted to channels first as a view, without a copy (memory stays channels last).
    """
    kind = key.removeprefix("right_")
    tensor = torch.from_numpy(stacked)
    if kind == "rgb":
        return tensor.permute(0, 3, 1, 2)
    return tensor[:, None] if kind in ("depth", "mask") else tensor


class _StreamedRows(TorchIterableDataset[Mapping[str, Any]]):
    """Torch iterable over a streamed dataset; ``datasets`` assigns separate shards to each worker."""

    def __init__(self, rows: IterableDataset) -> None:
        self.rows = rows

    def __iter__(self) -> Iterator[Mapping[str, Any]]:
        return iter(self.rows)
