"""Decoding of a row's cells to NumPy arrays of the shapes of its config."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Self

from rebar_depth_bench.data import codecs
from rebar_depth_bench.data.columns import column_kind
from rebar_depth_bench.data.dataset_config import DatasetConfig
from rebar_depth_bench.data.eye_view import CAMERA_KINDS, camera_array, is_absent
from rebar_depth_bench.errors import DatasetError, escape_text
from rebar_depth_bench.validation import short_repr


@dataclass(frozen=True)
class RowDecoder:
    """Decoder of the rows of a config; it is small and can be pickled for worker processes.

    ``grid`` is the image size (height, width) that every cell must have, ``scene_by_view`` the name of the
    scene of each view. The cells of ``absent_columns`` are null, or NaN in a matrix, and decode to None.
    """

    root: str
    config: str
    grid: tuple[int, int]
    scene_by_view: Mapping[str, str]
    absent_columns: frozenset[str] = frozenset()

    @classmethod
    def of(cls, config: DatasetConfig) -> Self:
        """Return the decoder of a config."""
        return cls(config.root, config.name, config.grid, config.scene_by_view, config.absent_columns)

    def row(self, row: Mapping[str, Any]) -> dict[str, Any]:
        """Decode the cells of a row. Raises ``DatasetError`` naming view and column if a cell is damaged."""
        view = str(row.get("view_id", f"a view of {self.config}"))
        return {name: self._decode(name, cell, view) for name, cell in row.items()}

    def encoded(self, row: Mapping[str, Any]) -> dict[str, Any]:
        """Return a row for ``datasets``, whose images stay encoded and have the path that ``picture`` expects.

        All other cells are checked. Raises ``DatasetError`` as ``row``.
        """
        return {name: self._encoded(name, cell, str(row["view_id"])) for name, cell in row.items()}

    def picture(self, column: str, content: bytes, path: str) -> codecs.Picture:
        """Decode the image in a cell of ``encoded``. Raises ``DatasetError`` as ``row``."""
        with self._naming(path.removeprefix(self.place), column):
            return codecs.open_picture(column_kind(column), content, self.grid)

    @property
    def place(self) -> str:
        """Start of the paths of images, before the id of the view."""
        return f"{self.root}/"

    def _encoded(self, column: str, cell: Any, view: str) -> Any:
        kind = column_kind(column)
        if kind not in codecs.PICTURE_KINDS or column in self.absent_columns:
            self._decode(column, cell, view)
            return cell
        with self._naming(view, column):
            return {"bytes": _content(kind, cell), "path": self.place + view}

    def _decode(self, column: str, cell: Any, view: str) -> Any:
        with self._naming(view, column):
            if column in self.absent_columns:
                if not is_absent(cell):
                    raise ValueError("it has a value, expected null as in the manifest")
                return None
            return self._decode_kind(column_kind(column), cell, view)

    @contextmanager
    def _naming(self, view: str, column: str) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # Pillow raises many types, which depend on the damage.
            reason = escape_text(str(error) or type(error).__name__)
            raise DatasetError(
                f"{self.root}: view {escape_text(view)}: {column} is damaged: {reason}; "
                f"rebar-bench verify {self.root} lists damaged files"
            ) from error

    def _decode_kind(self, kind: str, cell: Any, view: str) -> Any:
        if kind in codecs.PICTURE_KINDS:
            return codecs.decode(kind, _content(kind, cell), self.grid)
        if kind in CAMERA_KINDS:
            return camera_array(kind, cell)
        if kind == "view_id" and cell not in self.scene_by_view:
            raise ValueError("it is not in the manifest")
        if kind == "scene" and cell != (expected := self.scene_by_view.get(view, cell)):
            raise ValueError(f"got {short_repr(cell)}, expected {expected} as in the manifest")
        if kind == "baseline_m" and not (isinstance(cell, float) and math.isfinite(cell)):
            raise ValueError(f"got {cell}, expected a length in metres")
        return cell


def _content(kind: str, cell: Any) -> bytes:
    """Return the encoded image in a cell of a shard. Raises an error of any type for another cell."""
    content = cell if kind == "depth" else cell["bytes"]
    if not isinstance(content, bytes):
        raise ValueError("the cell holds no bytes")
    return content
