"""PyTorch data loader for a loaded config; importing it requires torch."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from datasets import Dataset, IterableDataset

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
_RIGHT = {f"right_{key}": column.replace("left", "right") for key, column in _LEFT.items()}


def torch_loader(
    ds: Dataset | IterableDataset,
    batch_size: int = 1,
    num_workers: int = 0,
    *,
    shuffle: bool = False,
    stereo: bool = False,
) -> DataLoader[Batch]:
    """Return a ``DataLoader`` over a dataset returned by ``load``, streaming or not.

    A batch is a dict: ``rgb`` uint8 B x 3 x H x W, ``depth`` float32 B x 1 x H x W (planar, metres, 0 where there
    is no surface), ``mask`` bool B x 1 x H x W, ``K`` float64 B x 3 x 3 (pixels), ``poses`` float64 B x 4 x 4
    (``cam_from_world``), all of the left view, and ``view_id``, a list of str. With ``stereo`` the batch also has
    the same keys of the right view, prefixed ``right_``, and ``baseline_m`` float64 B. Batches of a config without
    colour lack ``rgb`` and ``right_rgb``, and those of an imported config all that it lacks.

    Columns that a batch does not need are not decoded, except in a streamed dataset, whose columns are already
    decoded; pass ``columns`` to ``load`` to select them. ``shuffle`` requires a dataset that is not streamed.
    Importing this module without torch raises ``MethodError``.
    """
    keys = {**_LEFT, **_RIGHT, "baseline_m": "baseline_m"} if stereo else _LEFT
    rows = ds.select_columns(["view_id", *keys.values()])
    source = _StreamedRows(rows) if isinstance(rows, IterableDataset) else rows
    return DataLoader(
        source,
        batch_size=batch_size,
        num_workers=num_workers,
        shuffle=shuffle,
        collate_fn=_Collate(keys),
    )


class _Collate:
    """Collate function that stacks decoded rows into tensors; a class, so that it can be pickled for workers."""

    def __init__(self, keys: Mapping[str, str]) -> None:
        self._keys = keys

    def __call__(self, rows: Sequence[Mapping[str, Any]]) -> Batch:
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
        self._rows = rows

    def __iter__(self) -> Iterator[Mapping[str, Any]]:
        return iter(self._rows)
