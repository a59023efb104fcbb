"""``load``: a config of a dataset folder through plain ``datasets``, its rows decoded to numpy."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, overload

import datasets
import numpy as np
import pyarrow as pa
from datasets import Dataset, Image, IterableDataset
from datasets.exceptions import DatasetGenerationError, DatasetsError

from rebar_depth_bench import codecs
from rebar_depth_bench.errors import DatasetError
from rebar_depth_bench.folder import open_folder
from rebar_depth_bench.schema import column_kind, features

SPLIT = "test"


def _image_bytes(decode: Callable[[bytes], Any]) -> Callable[[Mapping[str, Any]], Any]:
    return lambda cell: decode(cell["bytes"])


def _float64(cell: object) -> Any:
    return np.asarray(cell, dtype=np.float64)


_DECODERS: Mapping[str, Callable[[Any], Any]] = {
    "rgb": _image_bytes(codecs.decode_rgb),
    "depth": codecs.decode_depth,
    "mask": _image_bytes(codecs.decode_mask),
    "bars": _image_bytes(codecs.decode_bars),
    "preview": _image_bytes(codecs.decode_rgb),
    "K": _float64,
    "distortion": _float64,
    "cam_from_world": _float64,
}
"""How a cell of each kind of column is decoded; a column's kind is its name without the eye."""


@overload
def load(
    root: str | Path, config: str, *, streaming: Literal[False] = False, columns: Sequence[str] | None = None
) -> Dataset: ...


@overload
def load(
    root: str | Path, config: str, *, streaming: Literal[True], columns: Sequence[str] | None = None
) -> IterableDataset: ...


def load(
    root: str | Path, config: str, *, streaming: bool = False, columns: Sequence[str] | None = None
) -> Dataset | IterableDataset:
    """Load a config of a dataset folder or Hub repository.

    Rows are dicts with the contract's columns decoded: colour uint8 H x W x 3, depth float32 H x W (planar,
    metres, 0 where no surface), masks bool H x W, bar ids uint16 H x W, K float64 3 x 3 in pixels, distortion
    float64 5, poses float64 4 x 4. ``columns`` keeps only the named ones, which saves decoding the others.
    With ``streaming`` rows come one by one from an ``IterableDataset`` and nothing is copied to the cache.

    Raises ``DatasetError`` for a folder, config or column that does not exist.
    """
    undecoded = load_undecoded(root, config, streaming=streaming, columns=columns)
    if isinstance(undecoded, IterableDataset):
        return undecoded.map(decode_row)
    return undecoded.with_transform(decode_batch)


def load_undecoded(
    root: str | Path, config: str, *, streaming: bool, columns: Sequence[str] | None
) -> Dataset | IterableDataset:
    """Load a config whose image and depth cells are still bytes, for ``decode_row``. Raises as ``load`` does."""
    open_folder(root).config(config)
    kept = _checked_columns(columns)
    try:
        loaded = datasets.load_dataset(str(root), config, split=SPLIT, streaming=streaming)
    except (DatasetsError, DatasetGenerationError, OSError, pa.ArrowException) as error:
        raise DatasetError(f"{root}: config {config} cannot be loaded: {error}") from error
    selected = loaded.select_columns(list(kept))
    for name in kept:
        if isinstance(selected.features[name], Image):
            selected = selected.cast_column(name, Image(decode=False))  # a change of reading, not of data
    return selected


def iterate(root: str | Path, config: str, columns: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Yield a config's decoded rows one by one, nothing cached. Raises ``DatasetError`` for damaged shards."""
    rows = iter(load(root, config, streaming=True, columns=columns))
    while True:
        try:
            row = next(rows)
        except StopIteration:
            return
        except (OSError, pa.ArrowException, DatasetsError) as error:
            raise DatasetError(f"{root}: config {config} cannot be read: {error}") from error
        yield row


def decode_row(row: Mapping[str, Any]) -> dict[str, Any]:
    """Decode the cells of one row whose images are still bytes."""
    return {name: _decoder(name)(cell) for name, cell in row.items()}


def decode_batch(batch: Mapping[str, Sequence[Any]]) -> dict[str, list[Any]]:
    """Decode a dict of columns, as ``datasets`` hands it to a transform."""
    return {name: [_decoder(name)(cell) for cell in cells] for name, cells in batch.items()}


def _decoder(column: str) -> Callable[[Any], Any]:
    return _DECODERS.get(column_kind(column), _as_it_is)


def _as_it_is(cell: Any) -> Any:
    return cell


def _checked_columns(columns: Sequence[str] | None) -> tuple[str, ...]:
    known = tuple(features())
    if columns is None:
        return known
    unknown = [name for name in columns if name not in known]
    if unknown:
        raise DatasetError(f"no column {', '.join(map(repr, unknown))}, expected some of {', '.join(known)}")
    return tuple(columns)
