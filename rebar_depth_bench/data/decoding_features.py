"""Features of ``datasets`` that decode the columns of a config; importing them takes a second.

The columns of a loaded dataset decode to pictures of Pillow and to lists, of which every format of ``datasets``
makes its arrays or tensors. Those of a streamed dataset, which loses the types of its columns in ``map``, decode
to arrays. Copies that ``datasets`` restores from files have the features as which these are stored.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, is_dataclass
from typing import Any, ClassVar

import numpy as np
import pyarrow as pa
from datasets import Features, Image, List, Value

from rebar_depth_bench.data.codecs import PICTURE_KINDS, Picture
from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.data.rows import is_absent, open_cell, picture_place
from rebar_depth_bench.data.schema import CAMERA_SHAPES, column_kind, features

STORED_MODES = {"depth": "F", "preview": "RGB"}
"""Modes of ``datasets.Image`` by kind of column; the images of the other kinds are stored in their modes."""


def decoding_features(config: DatasetConfig, columns: Sequence[str], *, to_arrays: bool = False) -> Features:
    """Return features that are stored as ``features`` with depth as an image.

    They decode to arrays, or to pictures and lists, of which the format ``numpy`` makes the same arrays.
    """
    by_name = features()
    for name in columns:
        if column_kind(name) in PICTURE_KINDS:
            by_name[name] = _Images(config.root, config.grid, name, to_arrays)
        elif column_kind(name) in CAMERA_SHAPES:
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

    It decodes images of the config's shards, which ``row_of_pictures`` marks by their paths, with all checks of
    their content, and others, as from ``map``, as ``datasets.Image`` does.
    """

    def __init__(self, root: str, grid: tuple[int, int], column: str, to_arrays: bool) -> None:
        super().__init__(mode=STORED_MODES.get(column_kind(column)))
        self._root = root
        self._grid = grid
        self._column = column
        self._to_arrays = to_arrays

    def encode_example(self, value: Any) -> Any:
        """Return the stored cell of a picture, an array or a cell of ``row_of_pictures``."""
        return value if self._is_of_shard(value) else super().encode_example(value)

    def decode_example(self, value: Any, token_per_repo_id: Any = None) -> Any:
        """Return the image in a cell. Raises ``DatasetError`` for a damaged image of the config's shards."""
        if self._is_of_shard(value):
            picture = open_cell(self._root, self._grid, self._column, value)
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
        return isinstance(value, dict) and (value["path"] or "").startswith(picture_place(self._root))


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
