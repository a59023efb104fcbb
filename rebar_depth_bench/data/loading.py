"""Loading of configs through ``datasets``: rows of NumPy arrays, or what its other formats make of the columns.

A loaded dataset has the format ``numpy`` of ``datasets``. Its columns decode to pictures of Pillow and to lists, of
which every format makes its arrays or tensors. Importing this module takes a second, since it imports ``datasets``.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal, overload

import numpy as np
from datasets import Dataset, Features, Image, IterableDataset, List, NamedSplit, ReadInstruction, Value

from rebar_depth_bench.data.codecs import Picture
from rebar_depth_bench.data.columns import COLUMNS, column_kind, features, validated_columns
from rebar_depth_bench.data.dataset_config import DatasetConfig
from rebar_depth_bench.data.decoding import PICTURE_KINDS, RowDecoder
from rebar_depth_bench.data.eye_view import CAMERA_KINDS, is_absent
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.shards import check_shards, damaged_error, iterate_shards
from rebar_depth_bench.errors import DatasetError, InputError, escape_text
from rebar_depth_bench.view_ids import TEST_SPLIT

PICTURE_MODES = {"depth": "F", "preview": "RGB"}
"""Modes of ``datasets.Image`` by kind of column; the images of the other kinds are stored in their modes."""
_CACHE_VERSION = 1
_ROWS_IN_MEMORY = 8
"""Rows that are kept in memory until they are written to the cache of ``datasets``."""


@overload
def load(
    root: str | Path,
    config: str,
    *,
    split: str = TEST_SPLIT,
    streaming: Literal[False] = False,
    columns: Sequence[str] | None = None,
) -> Dataset: ...


@overload
def load(
    root: str | Path,
    config: str,
    *,
    split: str = TEST_SPLIT,
    streaming: Literal[True],
    columns: Sequence[str] | None = None,
) -> IterableDataset: ...


@overload
def load(
    root: str | Path,
    config: str,
    *,
    split: str = TEST_SPLIT,
    streaming: bool,
    columns: Sequence[str] | None = None,
) -> Dataset | IterableDataset: ...


def load(
    root: str | Path,
    config: str,
    *,
    split: str = TEST_SPLIT,
    streaming: bool = False,
    columns: Sequence[str] | None = None,
) -> Dataset | IterableDataset:
    """Load one split of a config of a dataset folder or Hub repository, by default ``test``.

    Rows are dicts of decoded columns: colour uint8 H x W x 3, depth float32 H x W (planar, metres, 0 where no
    surface), masks bool H x W, bar ids uint16 H x W, K float64 3 x 3 in pixels, distortion float64 5, poses
    float64 4 x 4; None for colour of a config that was built without, and for what a config was imported without.
    ``split`` may be a part of a split, as ``"test[:10]"`` or ``"test[50%:]"``. ``columns`` selects columns; the
    others are not decoded. With ``streaming`` the result is an ``IterableDataset``, and nothing is copied to the
    cache of ``datasets``.

    The result has the format ``numpy``. Image columns are ``datasets.Image``: ``with_format("torch")`` makes
    tensors of them, ``with_format(None)`` and ``with_transform`` give pictures of Pillow and matrices as lists.

    Raises ``DatasetError`` for a folder, config, split or column that does not exist, for a damaged shard, and for
    a cell that contradicts the manifest; the rows raise it for a damaged image. A streamed dataset raises it while
    it is read.
    """
    located = open_folder(root).config(config).of_split(split.partition("[")[0])
    part, selected = _part(located, split), validated_columns(columns)
    check_shards(located)
    decoder = RowDecoder.of(located)
    loaded: Dataset | IterableDataset
    if streaming:
        loaded = IterableDataset.from_generator(
            _encoded_rows,
            features=_decoding_features(decoder, selected),
            gen_kwargs={"config": located, "columns": selected, "shards": list(located.shards)},
            split=NamedSplit(located.scenes[0].split),
        )
    else:
        loaded = _cached(located).select_columns(list(selected))
    loaded.info.features = _decoding_features(decoder, selected)
    loaded = loaded.with_format("numpy")
    if part is None:
        return loaded
    return loaded.skip(part.start).take(len(part)) if streaming else loaded.select(part)


def _part(config: DatasetConfig, split: str) -> range | None:
    """Return the positions of a part of the split of ``config``, None for all of it."""
    name = config.scenes[0].split
    if split == name:
        return None
    try:
        [part] = ReadInstruction.from_spec(split).to_absolute({name: len(config.views)})
        return range(part.from_, part.to)
    except Exception as error:  # ``datasets`` asserts some properties of a part.
        found = f"{config.root}: split {escape_text(split)} is no part of {name}: {error}"
        raise DatasetError(f"{found}; expected one as {name}[:10] or {name}[50%:]") from None


def _encoded_rows(config: DatasetConfig, columns: Sequence[str], shards: Sequence[str]) -> Iterator[dict[str, Any]]:
    decoder = RowDecoder.of(config)
    for row in iterate_shards(config, ("view_id", *columns), shards):
        encoded = decoder.encoded(row)
        yield {name: encoded[name] for name in columns}


def _cached(config: DatasetConfig) -> Dataset:
    """Return the rows of a config from the cache of ``datasets``, into which they are copied at the first call.

    The cache is mapped into memory. Its key covers the manifest's entry of the config, and place, size and time of
    the shards. ``datasets`` never reads the dataset's README.md, whose ``data_files`` could be any files.
    """
    split = config.scenes[0].split
    files = [config.file(shard).absolute() for shard in config.shards]
    stamps = [(str(file), file.stat().st_size, file.stat().st_mtime_ns) for file in files]
    key = json.dumps([_CACHE_VERSION, config.root, split, stamps, config.manifest_entry], sort_keys=True)
    try:
        return Dataset.from_generator(
            _encoded_rows,
            features=_decoding_features(RowDecoder.of(config), COLUMNS),
            gen_kwargs={"config": config, "columns": COLUMNS, "shards": list(config.shards)},
            split=NamedSplit(split),
            fingerprint=hashlib.sha256(key.encode()).hexdigest()[:32],
            config_name=config.name,
            writer_batch_size=_ROWS_IN_MEMORY,
        )
    except Exception as error:  # ``datasets`` raises many types, which depend on the damage.
        if isinstance(error.__cause__, InputError):
            raise error.__cause__ from None
        raise damaged_error(config, error) from error


def _decoding_features(decoder: RowDecoder, columns: Sequence[str]) -> Features:
    """Return features that are stored as ``features`` with depth as an image, and decode with ``decoder``."""
    small, by_name = replace(decoder, scene_by_view={}), features()
    for name in columns:
        if (kind := column_kind(name)) in PICTURE_KINDS:
            by_name[name] = _Images(small, name)
        elif kind in CAMERA_KINDS:
            stored = by_name[name]
            by_name[name] = _Matrices(stored.feature, stored.length)
        elif kind == "baseline_m":
            by_name[name] = _Numbers(by_name[name].dtype)
    return Features({name: by_name[name] for name in columns})


class _Stored:
    """Feature that is stored as, and equal to, the feature of ``datasets`` with the same fields."""

    def __eq__(self, other: object) -> bool:
        return is_dataclass(other) and _stored(self) == _stored(other)

    __hash__ = None  # type: ignore[assignment]


def _stored(feature: object) -> Any:
    return Features({"cell": feature}).to_dict()


class _Images(_Stored, Image):  # type: ignore[misc]
    """Image column of a config, stored as ``datasets.Image``.

    It decodes images of the config's shards, which ``RowDecoder.encoded`` marks by their paths, with all checks of
    their content, and others, as from ``map``, as ``datasets.Image`` does.
    """

    def __init__(self, decoder: RowDecoder, column: str) -> None:
        super().__init__(mode=PICTURE_MODES.get(column_kind(column)))
        self._decoder = decoder
        self._column = column

    def encode_example(self, value: Any) -> Any:
        """Return the stored cell of a picture, an array or a cell of ``RowDecoder.encoded``."""
        return value if self._is_of_shard(value) else super().encode_example(value)

    def decode_example(self, value: Any, token_per_repo_id: Any = None) -> Any:
        """Return the picture in a cell. Raises ``DatasetError`` for a damaged image of the config's shards."""
        if self._is_of_shard(value):
            return self._decoder.picture(self._column, value["bytes"], value["path"])
        picture = super().decode_example(value, token_per_repo_id)
        return picture if isinstance(picture, Picture) else Picture(picture)

    def _is_of_shard(self, value: Any) -> bool:
        return isinstance(value, dict) and (value["path"] or "").startswith(self._decoder.place)


class _Numbers(_Stored, Value):  # type: ignore[misc]
    """Column of numbers, stored as ``datasets.Value``; the format ``numpy`` keeps its scalars."""

    def decode_example(self, value: float, token_per_repo_id: Any = None) -> np.float64:
        """Return the number in a cell."""
        return np.float64(value)


@dataclass(eq=False)
class _Matrices(_Stored):
    """Column of matrices or vectors, stored as ``datasets.List``; the format ``numpy`` keeps their float64.

    That format converts arrays to float32, but not scalars, so the cells decode to lists of scalars.
    """

    feature: Any
    length: int
    _type: str = field(default="List", init=False)

    def __call__(self) -> Any:
        return Features({"cell": List(self.feature, self.length)}).type[0].type

    def encode_example(self, value: Any) -> Any:
        """Return the stored cell of a matrix."""
        return np.asarray(value).tolist()

    def decode_example(self, value: Any, token_per_repo_id: Any = None) -> list[Any] | None:
        """Return the matrix in a cell as lists of NumPy's scalars, None for an absent one."""
        matrix = np.array([*value], dtype=np.float64)
        if is_absent(matrix.tolist()):
            return None
        return [list(row) if matrix.ndim > 1 else row for row in matrix]
