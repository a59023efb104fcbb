"""Loading of configs through ``datasets``: rows of NumPy arrays, or what other formats make of the columns.

The columns of a loaded dataset decode to pictures of Pillow and to lists, of which every format of ``datasets``
makes its arrays or tensors. Those of a streamed dataset, which loses the types of its columns in ``map``, decode
to arrays. Copies that ``datasets`` restores from files have the features as which these are stored.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, overload

import numpy as np
import pyarrow as pa
from datasets import Features, Image, List, Value

from rebar_depth_bench.data.codecs import PICTURE_KINDS, Picture
from rebar_depth_bench.data.manifest import DatasetConfig, open_folder
from rebar_depth_bench.data.rows import CAMERA_KINDS, RowDecoder, is_absent
from rebar_depth_bench.data.schema import COLUMNS, column_kind, features, validated_columns
from rebar_depth_bench.data.shards import check_shards, damaged_error, iterate_shards
from rebar_depth_bench.errors import DatasetError, InputError, escape_text
from rebar_depth_bench.names import TEST_SPLIT

if TYPE_CHECKING:
    from datasets import Dataset, IterableDataset


STORED_MODES = {"depth": "F", "preview": "RGB"}
"""Modes of ``datasets.Image`` by kind of column; the images of the other kinds are stored in their modes."""


def decoding_features(config: DatasetConfig, columns: Sequence[str], *, to_arrays: bool = False) -> Features:
    """Return features that are stored as ``features`` with depth as an image.

    They decode to arrays, or to pictures and lists, of which the format ``numpy`` makes the same arrays.
    """
    decoder, by_name = replace(RowDecoder.of(config), scene_by_view={}), features()
    for name in columns:
        if column_kind(name) in PICTURE_KINDS:
            by_name[name] = _Images(decoder, name, to_arrays)
        elif column_kind(name) in CAMERA_KINDS:
            by_name[name] = _Matrices(by_name[name].feature, by_name[name].length)
            by_name[name].to_arrays = to_arrays
        else:
            by_name[name] = _Scalars(by_name[name].dtype)
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

    def __init__(self, decoder: RowDecoder, column: str, to_arrays: bool) -> None:
        super().__init__(mode=STORED_MODES.get(column_kind(column)))
        self._decoder = decoder
        self._column = column
        self._to_arrays = to_arrays

    def encode_example(self, value: Any) -> Any:
        """Return the stored cell of a picture, an array or a cell of ``RowDecoder.encoded``."""
        return value if self._is_of_shard(value) else super().encode_example(value)

    def decode_example(self, value: Any, token_per_repo_id: Any = None) -> Any:
        """Return the image in a cell. Raises ``DatasetError`` for a damaged image of the config's shards."""
        if self._is_of_shard(value):
            picture = self._decoder.picture(self._column, value["bytes"], value["path"])
        else:
            picture = Picture(super().decode_example(value, token_per_repo_id))
        return np.asarray(picture) if self._to_arrays else picture

    def cast_storage(self, storage: Any) -> Any:
        """Return the stored cells of an Arrow array, as ``map`` makes it of the arrays of images."""
        if pa.types.is_list(storage.type):
            kind = column_kind(self._column)
            cells = [
                self.encode_example(_image_array(cell.values, kind)) if cell.is_valid else None for cell in storage
            ]
            storage = pa.array(cells, type=self.pa_type)
        return super().cast_storage(storage)

    def _is_of_shard(self, value: Any) -> bool:
        return isinstance(value, dict) and (value["path"] or "").startswith(self._decoder.place)


def _image_array(values: pa.Array, kind: str) -> np.ndarray[Any, Any]:
    """Convert nested lists of an image's pixels to an array."""
    shape = [len(values)]
    while pa.types.is_list(values.type):
        values = values.flatten()
        shape.append(len(values) // math.prod(shape))
    return np.asarray(values.to_numpy(zero_copy_only=False).reshape(shape), dtype=PICTURE_KINDS[kind].dtype)


class _Scalars(_Stored, Value):  # type: ignore[misc]
    """Column of texts or numbers, stored as ``datasets.Value``."""

    def decode_example(self, value: Any, **_: Any) -> Any:
        """Return the text or number in a cell, None for an absent number, which ``datasets`` may read as NaN."""
        if self.dtype == "string":
            return str(value)
        return None if np.isnan(value) else np.float64(value)


@dataclass(eq=False)
class _Matrices(_Stored):
    """Column of matrices or vectors, stored as ``datasets.List``; the format ``numpy`` keeps their float64.

    That format converts arrays to float32, but not scalars, so the cells decode to lists of scalars.
    """

    feature: Any
    length: int
    to_arrays: ClassVar[bool] = False
    _type: str = field(default="List", init=False)

    def __call__(self) -> Any:
        return Features({"cell": List(self.feature, self.length)}).type[0].type

    def encode_example(self, value: Any) -> Any:
        """Return the stored cell of a matrix."""
        return np.asarray(value).tolist()

    def decode_example(self, value: Any, **_: Any) -> Any:
        """Return the matrix in a cell as an array or as lists of NumPy's scalars, None for an absent one."""
        matrix = np.array([*value], dtype=np.float64)
        if is_absent(matrix.tolist()):
            return None
        return matrix if self.to_arrays else [list(row) if matrix.ndim > 1 else row for row in matrix]


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

    Image columns are ``datasets.Image``. A ``Dataset`` has the format ``numpy``: ``with_format("torch")`` makes
    tensors, ``with_format(None)`` and ``with_transform`` give pictures of Pillow, and matrices as lists.

    Raises ``DatasetError`` for a folder, config, split or column that does not exist, for a damaged shard, and for
    a cell that contradicts the manifest; the rows raise it for a damaged image. A streamed dataset raises it while
    it is read.
    """
    from datasets import IterableDataset, NamedSplit

    from rebar_depth_bench.data.loading import decoding_features

    whole = split.partition("[")[0] if split.endswith("]") else split
    located = open_folder(root).config(config).of_split(whole)
    part = None if split == whole else _part(located, split)
    selected = validated_columns(columns)
    check_shards(located)
    if streaming:
        streamed = IterableDataset.from_generator(
            _encoded_rows,
            features=decoding_features(located, selected, to_arrays=True),
            gen_kwargs={"config": located, "columns": selected, "shards": list(located.shards)},
            split=NamedSplit(whole),
        )
        return streamed if part is None else streamed.skip(part.start).take(len(part))
    loaded = _cached(located, whole).select_columns(list(selected))
    loaded.info.features = decoding_features(located, selected)
    formatted = loaded.with_format("numpy")
    return formatted if part is None else formatted.select(part)


def _part(config: DatasetConfig, split: str) -> range:
    """Return the positions of a part of the split of ``config``. Raises ``DatasetError`` if it is none."""
    from datasets import ReadInstruction

    try:
        [part] = ReadInstruction.from_spec(split).to_absolute({config.scenes[0].split: len(config.views)})
        return range(part.from_, part.to)
    except Exception as error:  # ``datasets`` asserts some properties of a part.
        found = f"{config.root}: {escape_text(split)} is no part of a split: {error}"
        raise DatasetError(f"{found}; expected one as test[:10] or test[50%:]") from None


def _encoded_rows(
    config: DatasetConfig, columns: Sequence[str], shards: Sequence[str]
) -> Iterator[dict[str, Any]]:
    decoder = RowDecoder.of(config)
    for row in iterate_shards(config, ("view_id", *columns), shards):
        encoded = decoder.encoded(row)
        yield {name: encoded[name] for name in columns}


def _cached(config: DatasetConfig, split: str) -> Dataset:
    """Return the rows of a config from the cache of ``datasets``, into which they are copied at the first call.

    The cache is mapped into memory. Its key covers the manifest's entry of the config, and place, size and time of
    the shards. ``datasets`` never reads the dataset's README.md, whose ``data_files`` could be any files.
    """
    from datasets import Dataset, NamedSplit

    from rebar_depth_bench.data.loading import decoding_features

    files = [config.file(shard).absolute() for shard in config.shards]
    stamps = [(str(file), file.stat().st_size, file.stat().st_mtime_ns) for file in files]
    key = json.dumps([_CACHE_VERSION, config.root, split, stamps, config.manifest_entry], sort_keys=True)
    try:
        return Dataset.from_generator(
            _encoded_rows,
            features=decoding_features(config, COLUMNS),
            gen_kwargs={"config": config, "columns": COLUMNS, "shards": list(config.shards)},
            split=NamedSplit(split),
            fingerprint=hashlib.sha256(key.encode()).hexdigest()[:32],
            config_name=config.name,
            writer_batch_size=_ROWS_IN_MEMORY,
        )
    except Exception as error:  # ``datasets`` wraps what reading a shard raises.
        cause = error.__cause__ if isinstance(error.__cause__, Exception) else error
        raise cause if isinstance(cause, InputError) else damaged_error(config, cause) from error
