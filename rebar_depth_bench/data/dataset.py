"""Dataset rows: columns and features, loading through ``datasets``, and decoding to NumPy.

``load`` returns a config as a ``datasets`` object whose rows decode to NumPy arrays; ``ConfigViews`` gives access
to all views of a config for methods that need more than one view at a time. ``datasets`` takes a second to import,
which commands that read only cached ground truth do not need, so functions import it on use.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from rebar_depth_bench.data import codecs
from rebar_depth_bench.data.manifest import DatasetConfig, open_folder
from rebar_depth_bench.errors import DatasetError, escape_text
from rebar_depth_bench.geometry.aruco_board import BoardSpec

if TYPE_CHECKING:
    from datasets import Dataset, Features, IterableDataset

EYES = ("left", "right")
COLUMNS = (
    "view_id",
    *(f"{eye}_{kind}" for kind in ("rgb", "depth", "mask", "bars") for eye in EYES),
    "left_preview",
    *(f"{eye}_{kind}" for kind in ("K", "distortion", "cam_from_world") for eye in EYES),
    "baseline_m",
)
"""Names of the columns, in order."""


def features(*, decode_images: bool = True) -> Features:
    """Return the ``datasets`` features of a row, in column order.

    With ``decode_images=False`` image columns are left as encoded bytes.
    """
    from datasets import Features, Image, List, Value

    image, number = Image(decode=decode_images), Value("float64")
    by_kind = {
        "view_id": Value("string"),
        **dict.fromkeys(("rgb", "mask", "bars", "preview"), image),
        "depth": Value("binary"),
        "K": List(List(number, length=3), length=3),
        "distortion": List(number, length=5),
        "cam_from_world": List(List(number, length=4), length=4),
        "baseline_m": number,
    }
    return Features({name: by_kind[column_kind(name)] for name in COLUMNS})


COLUMN_DESCRIPTIONS: dict[str, str] = {
    "view_id": "`<config>/<0000>`: the view's index in its full protocol, also when a subset is built",
    "rgb": "lossless 8-bit colour, H x W, WebP",
    "depth": "lossless float32 planar depth along the optical axis, metres, 0.0 where there is no surface; "
    'TIFF, which `Image(mode="F")` of `datasets` reads too',
    "mask": "1-bit: steel, rim included",
    "bars": "16-bit: the bar's id as in `bars.parquet`, 0 where no steel",
    "preview": "8-bit colour-mapped depth, for people and the Hub viewer",
    "K": "3 x 3 pinhole matrix, pixels; pixel centres at integer coordinates",
    "distortion": "k1 k2 p1 p2 k3 (OpenCV), zeros where the grid has none",
    "cam_from_world": "4 x 4 rigid pose: `x_cam = cam_from_world @ x_world`; OpenCV axes, metres",
    "baseline_m": "metres between the two camera centres; along the left one's x axis except on a raw grid",
}
"""Description of each column, by column kind (see ``column_kind``); shown in the dataset card."""


def column_kind(name: str) -> str:
    """Return the kind of a column: its name without the prefix ``left_`` or ``right_``."""
    eye, _, kind = name.partition("_")
    return kind if eye in EYES else name


_IMAGE_CELL = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
_ARROW_TYPES: Mapping[str, pa.DataType] = {
    "view_id": pa.string(),
    **dict.fromkeys(("rgb", "mask", "bars", "preview"), _IMAGE_CELL),
    "depth": pa.binary(),
    "K": pa.list_(pa.list_(pa.float64(), 3), 3),
    "distortion": pa.list_(pa.float64(), 5),
    "cam_from_world": pa.list_(pa.list_(pa.float64(), 4), 4),
    "baseline_m": pa.float64(),
}
ROW_SCHEMA = pa.schema([(name, _ARROW_TYPES[column_kind(name)]) for name in COLUMNS])
"""Arrow schema of ``features``, without its metadata."""

SPLIT = "test"
"""Split that is loaded."""


def _image_cell_decoder(decode: Callable[[bytes], Any]) -> Callable[[Mapping[str, Any]], Any]:
    return lambda cell: decode(cell["bytes"])


def _float64(cell: object) -> Any:
    return np.asarray(cell, dtype=np.float64)


_DECODERS: Mapping[str, Callable[[Any], Any]] = {
    "rgb": _image_cell_decoder(codecs.decode_rgb),
    "depth": codecs.decode_depth,
    "mask": _image_cell_decoder(codecs.decode_mask),
    "bars": _image_cell_decoder(codecs.decode_bars),
    "preview": _image_cell_decoder(codecs.decode_rgb),
    "K": _float64,
    "distortion": _float64,
    "cam_from_world": _float64,
}
"""Decoder of a cell, by column kind; columns of other kinds are left unchanged."""


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

    Rows are dicts of decoded columns: colour uint8 H x W x 3, depth float32 H x W (planar,
    metres, 0 where no surface), masks bool H x W, bar ids uint16 H x W, K float64 3 x 3 in pixels, distortion
    float64 5, poses float64 4 x 4. ``columns`` selects columns; the others are not decoded. With ``streaming``
    the result is an ``IterableDataset``, and nothing is copied to the cache of ``datasets``.

    Raises ``DatasetError`` for a folder, config or column that does not exist.
    """
    from datasets import IterableDataset

    undecoded = load_undecoded(open_folder(root).config(config), streaming=streaming, columns=columns)
    if isinstance(undecoded, IterableDataset):
        return undecoded.map(decode_row)
    return undecoded.with_transform(decode_batch)


def load_undecoded(
    config: DatasetConfig, *, streaming: bool, columns: Sequence[str] | None
) -> Dataset | IterableDataset:
    """Load a config with image and depth cells left as bytes, to be decoded by ``decode_row``.

    Raises ``DatasetError`` as ``load`` does.
    """
    import datasets
    from datasets.exceptions import DatasetsError

    selected_columns = _validated_columns(columns)
    if config.local is not None:
        for shard in config.shards:
            config.file(shard)  # ``datasets`` loads the shards that it finds, without an error for the others.
    try:
        loaded = datasets.load_dataset(config.root, config.name, split=SPLIT, streaming=streaming)
    except (DatasetsError, OSError, pa.ArrowException) as error:
        raise DatasetError(f"{config.root}: config {config.name} cannot be loaded: {error}") from error
    selected = loaded.select_columns(list(selected_columns))
    for name in selected_columns:
        if isinstance(selected.features[name], datasets.Image):
            selected = selected.cast_column(name, datasets.Image(decode=False))  # This changes only the decoding.
    return selected


def iterate_rows(config: DatasetConfig, columns: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Yield the decoded rows of a config, one at a time, without a cache.

    Raises ``DatasetError`` if the config cannot be loaded, a shard is damaged or holds a view of another config.
    """
    known = frozenset(config.view_ids)
    for row in iterate_undecoded(config, columns):
        if "view_id" in row and row["view_id"] not in known:  # Ids become names of files.
            raise DatasetError(f"{config.root}: view {escape_text(str(row['view_id']))} is not in the manifest")
        try:
            decoded = decode_row(row)
        except (OSError, TypeError, ValueError) as error:
            raise DatasetError(f"{config.root}: config {config.name} cannot be read: {error}") from error
        yield decoded


def iterate_undecoded(config: DatasetConfig, columns: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Yield the rows of a config with encoded images and depth, one at a time, to be decoded by ``decode_row``.

    The shards of a local folder are read with pyarrow: ``datasets`` takes a second to import, and imports torch,
    which takes several, to stream. Hub repositories are streamed. Raises ``DatasetError`` as ``iterate_rows``.
    """
    read = _streamed_rows if config.local is None else _shard_rows
    return read(config, _validated_columns(columns))


def _shard_rows(config: DatasetConfig, columns: Sequence[str]) -> Iterator[dict[str, Any]]:
    schema = pa.schema([ROW_SCHEMA.field(name) for name in columns])
    try:
        for name in config.shards:
            with pq.ParquetFile(config.file(name)) as shard:
                for batch in shard.iter_batches(batch_size=1, columns=schema.names):
                    yield from batch.select(schema.names).cast(schema).to_pylist()
    except (KeyError, OSError, pa.ArrowException) as error:
        raise DatasetError(f"{config.root}: config {config.name} cannot be read: {error}") from error


def _streamed_rows(config: DatasetConfig, columns: Sequence[str]) -> Iterator[dict[str, Any]]:
    from datasets.exceptions import DatasetsError

    try:
        yield from load_undecoded(config, streaming=True, columns=columns)
    except (DatasetsError, OSError, pa.ArrowException) as error:
        raise DatasetError(f"{config.root}: config {config.name} cannot be read: {error}") from error


def decode_row(row: Mapping[str, Any]) -> dict[str, Any]:
    """Decode the cells of a row of ``load_undecoded`` or ``iterate_undecoded``."""
    return {name: _decoder(name)(cell) for name, cell in row.items()}


def decode_batch(batch: Mapping[str, Sequence[Any]]) -> dict[str, list[Any]]:
    """Decode a dict of columns, the format that ``datasets`` passes to a transform."""
    return {name: [_decoder(name)(cell) for cell in cells] for name, cells in batch.items()}


def _decoder(column: str) -> Callable[[Any], Any]:
    return _DECODERS.get(column_kind(column), lambda cell: cell)


def _validated_columns(columns: Sequence[str] | None) -> tuple[str, ...]:
    if columns is None:
        return COLUMNS
    if isinstance(columns, str):
        raise DatasetError(f"columns is {columns!r}, expected a list of column names")
    unknown = [name for name in columns if name not in COLUMNS]
    if unknown:
        raise DatasetError(f"no column {', '.join(map(repr, unknown))}, expected some of {', '.join(COLUMNS)}")
    return tuple(columns)


@dataclass(frozen=True)
class ConfigViews:
    """Views, image size, board and mesh of one config of a dataset folder."""

    source: DatasetConfig

    @property
    def config(self) -> str:
        """Name of the config."""
        return self.source.name

    @property
    def view_ids(self) -> tuple[str, ...]:
        """Ids of the views, in order."""
        return self.source.view_ids

    @property
    def grid(self) -> tuple[int, int]:
        """Image size (height, width), pixels."""
        return self.source.grid

    @property
    def board(self) -> BoardSpec | None:
        """ArUco board under the assembly, or None."""
        return self.source.scene.board

    @property
    def mesh(self) -> Path:
        """Path of the scene's PLY mesh, which is ground truth. Raises ``DatasetError`` if it is missing."""
        return self.source.file(self.source.mesh)

    def rows(self, *columns: str) -> Iterator[dict[str, Any]]:
        """Yield the decoded ``view_id`` and named columns of each view, in order."""
        return iterate_rows(self.source, ("view_id", *columns))
