"""Features of ``datasets`` that decode the columns of a dataset; importing them takes a second.

Each feature is stored as, and equal to, a feature of ``datasets`` itself, which copies have that ``datasets``
restores from files.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, is_dataclass
from typing import Any, ClassVar

import numpy as np
import pyarrow as pa
from datasets import Features, Image, List, Value

from rebar_depth_bench.data.codecs import PICTURE_KINDS, Picture
from rebar_depth_bench.data.rows import is_absent, is_image_cell, open_image_cell
from rebar_depth_bench.data.schema import CAMERA_SHAPES, column_kind, features

STORED_MODES = {"depth": "F", "preview": "RGB"}
"""Modes of ``datasets.Image`` by kind of column; the images of the other kinds are stored in their modes."""


def decoding_features(columns: Sequence[str], *, to_arrays: bool = False) -> Features:
    """Return the features that decode columns.

    The cells decode to pictures of Pillow and to lists, of which every format of ``datasets`` makes its arrays or
    tensors. With ``to_arrays`` they decode to arrays, because a streamed dataset loses the types of its columns in
    ``map``.
    """
    stored, decoding = features(), Features()
    for name in columns:
        if column_kind(name) in PICTURE_KINDS:
            decoding[name] = _Image(name, to_arrays)
        elif column_kind(name) in CAMERA_SHAPES:
            decoding[name] = _Matrix(stored[name].feature, stored[name].length)
            decoding[name].to_arrays = to_arrays
        else:
            decoding[name] = _Scalar(stored[name].dtype)
    return decoding


class _Stored:
    """Feature that equals the feature of ``datasets`` as which it is stored."""

    def __eq__(self, other: object) -> bool:
        return is_dataclass(other) and asdict(self) == asdict(other)  # type: ignore[call-overload,arg-type]


class _Image(_Stored, Image):  # type: ignore[misc]
    """Column of images, which decodes an image of a shard with all checks of its content.

    ``datasets.Image`` decodes an image of any size, and its errors name neither view nor column. It still decodes
    other images, which ``map`` has changed.
    """

    def __init__(self, column: str, to_arrays: bool) -> None:
        super().__init__(mode=STORED_MODES.get(column_kind(column)))
        self._column = column
        self._to_arrays = to_arrays

    def decode_example(self, value: Any, token_per_repo_id: Any = None) -> Any:
        """Return the image in a cell. Raises ``DatasetError`` for a damaged image of a shard."""
        if is_image_cell(value):
            picture = open_image_cell(self._column, value)
        else:
            picture = Picture(super().decode_example(value, token_per_repo_id))
        return np.asarray(picture) if self._to_arrays else picture

    def cast_storage(self, storage: Any) -> Any:
        """Return the stored cells of an Arrow array, which is of lists if ``map`` has returned arrays.

        ``datasets`` would take three times as long, and make 32-bit integers of bar ids.
        """
        if pa.types.is_list(storage.type):
            dtype = PICTURE_KINDS[column_kind(self._column)].dtype
            cells = [
                self.encode_example(_array_of_lists(cell.values, dtype)) if cell.is_valid else None
                for cell in storage
            ]
            storage = pa.array(cells, self.pa_type)
        return super().cast_storage(storage)


def _array_of_lists(values: pa.Array, dtype: type[np.generic]) -> np.ndarray[Any, Any]:
    """Convert nested lists of equal lengths to an array."""
    shape = [len(values)]
    while pa.types.is_list(values.type):
        values = values.flatten()
        shape.append(len(values) // math.prod(shape))
    return np.asarray(values.to_numpy(zero_copy_only=False).reshape(shape), dtype)


class _Scalar(_Stored, Value):  # type: ignore[misc]
    """Column of texts or numbers, of which the format ``numpy`` keeps str, float64 and None."""

    def decode_example(self, value: Any, **_: Any) -> Any:
        """Return the text or number in a cell, None for an absent number, which ``datasets`` may read as NaN."""
        if self.dtype == "string":
            return str(value)
        return None if np.isnan(value) else np.float64(value)


@dataclass(eq=False)
class _Matrix(_Stored):
    """Column of matrices or vectors, of which the format ``numpy`` keeps float64.

    That format converts arrays to float32, but not scalars, so the cells decode to lists of scalars.
    """

    feature: Any
    length: int
    id: None = None
    to_arrays: ClassVar[bool] = False
    _type: str = field(default="List", init=False, repr=False)

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
