"""Dataset rows: loading through ``datasets``, and iteration without it.

``load`` returns a config as a ``datasets`` object whose rows decode to NumPy arrays; ``ConfigViews`` gives access
to all views of a config for methods that need more than one view at a time. ``datasets`` takes a second to import,
which commands that read only cached ground truth do not need, so functions import it on use.
"""

from __future__ import annotations

import glob
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

from rebar_depth_bench.data.columns import COLUMNS, SPLIT, features, validated_columns
from rebar_depth_bench.data.decoding import RowDecoder
from rebar_depth_bench.data.manifest import DatasetConfig, open_folder
from rebar_depth_bench.data.shards import all_rows, check_shards, damaged_error, iterate_shards
from rebar_depth_bench.geometry.aruco_board import BoardSpec

if TYPE_CHECKING:
    from datasets import Dataset, IterableDataset


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

    Raises ``DatasetError`` for a folder, config or column that does not exist, and for a damaged shard; the rows
    raise it for a damaged cell.
    """
    located = open_folder(root).config(config)
    decoder, undecoded = RowDecoder.of(located), load_undecoded(located, streaming=streaming, columns=columns)
    return undecoded.map(decoder.row) if streaming else undecoded.with_transform(decoder.batch)


def load_undecoded(
    config: DatasetConfig, *, streaming: bool, columns: Sequence[str] | None
) -> Dataset | IterableDataset:
    """Load a config with image and depth cells left as bytes, to be decoded by ``RowDecoder``.

    ``datasets`` receives the shards of the manifest: it never reads the dataset's README.md, whose ``data_files``
    could be any files. Raises ``DatasetError`` as ``load`` does.
    """
    import datasets

    selected = validated_columns(columns)
    undecoded = features(decode_images=False)
    check_shards(config)
    if streaming:
        return datasets.IterableDataset.from_generator(
            iterate_shards,
            features=datasets.Features({name: undecoded[name] for name in selected}),
            gen_kwargs={"config": config, "columns": selected, "shards": list(config.shards)},
            split=datasets.NamedSplit(SPLIT),
        )
    paths = [glob.escape(str(config.file(shard).absolute())) for shard in config.shards]
    try:
        loaded = datasets.load_dataset(
            "parquet",
            config.name,
            data_files={SPLIT: paths},
            columns=list(COLUMNS),
            features=undecoded,
            split=SPLIT,
        )
    except Exception as error:  # ``datasets`` raises many types, which depend on the damage.
        raise damaged_error(config, error) from error
    return loaded.select_columns(list(selected))


def iterate_rows(config: DatasetConfig, columns: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Yield the decoded rows of a config, one at a time, without a cache.

    Raises ``DatasetError`` if a shard or a cell is damaged, and unless the rows are the views of the manifest.
    """
    return map(RowDecoder.of(config).row, iterate_undecoded(config, columns))


def iterate_undecoded(config: DatasetConfig, columns: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Yield the rows of a config with encoded images and depth, one at a time; ``RowDecoder`` decodes them.

    The shards are read with pyarrow: ``datasets`` takes a second to import, and imports torch, which takes
    several, to stream. Shards of the Hub are streamed. Raises ``DatasetError`` as ``iterate_rows``.
    """
    return all_rows(config, validated_columns(columns))


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
