"""Dataset rows: loading through ``datasets``, and iteration without it.

``load`` returns a config as a ``datasets`` object whose rows decode to NumPy arrays; ``ConfigViews`` gives access
to all views of a config for methods that need more than one view at a time. ``datasets`` takes a second to import,
which commands that read only cached ground truth do not need, so functions import it on use.
"""

from __future__ import annotations

import glob
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

from rebar_depth_bench.data.columns import COLUMNS, features, validated_columns
from rebar_depth_bench.data.dataset_config import DatasetConfig
from rebar_depth_bench.data.decoding import RowDecoder
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.shards import all_rows, check_shards, damaged_error, iterate_shards
from rebar_depth_bench.errors import DatasetError
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.view_ids import TEST_SPLIT

if TYPE_CHECKING:
    from datasets import Dataset, IterableDataset


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
    ``columns`` selects columns; the others are not decoded. With ``streaming`` the result is an
    ``IterableDataset``, and nothing is copied to the cache of ``datasets``.

    Raises ``DatasetError`` for a folder, config, split or column that does not exist, and for a damaged shard; the
    rows raise it for a damaged cell.
    """
    located = open_folder(root).config(config).of_split(split)
    decoder, undecoded = RowDecoder.of(located), load_undecoded(located, streaming=streaming, columns=columns)
    return undecoded.map(decoder.row) if streaming else undecoded.with_transform(decoder.batch)


def load_undecoded(
    config: DatasetConfig, *, streaming: bool, columns: Sequence[str] | None
) -> Dataset | IterableDataset:
    """Load scenes of one split with image and depth cells left as bytes, to be decoded by ``RowDecoder``.

    ``datasets`` receives the shards of the manifest: it never reads the dataset's README.md, whose ``data_files``
    could be any files. Raises ``DatasetError`` as ``load`` does.
    """
    import datasets

    selected, split = validated_columns(columns), config.scenes[0].split
    undecoded = features(decode_images=False)
    check_shards(config)
    if streaming:
        return datasets.IterableDataset.from_generator(
            iterate_shards,
            features=datasets.Features({name: undecoded[name] for name in selected}),
            gen_kwargs={"config": config, "columns": selected, "shards": list(config.shards)},
            split=datasets.NamedSplit(split),
        )
    paths = [glob.escape(str(config.file(shard).absolute())) for shard in config.shards]
    try:
        loaded = datasets.load_dataset(
            "parquet",
            config.name,
            data_files={split: paths},
            columns=list(COLUMNS),
            features=undecoded,
            split=split,
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


def check_columns(config: DatasetConfig, columns: Sequence[str], reader: str) -> None:
    """Raise ``DatasetError`` if ``reader`` needs columns that are absent: built or imported without them."""
    needed = [name for name in columns if name in config.absent_columns]
    if not needed:
        return
    place = f"{config.root}: {reader} needs {', '.join(needed)}, but config {config.name} was"
    if config.imported is not None:
        raise DatasetError(f"{place} imported without them; choose other configs (--config)")
    raise DatasetError(
        f"{place} built without colour (rebar-build --no-colour); choose configs with colour (--config), or build "
        "it with colour"
    )


@dataclass(frozen=True)
class ConfigViews:
    """Views of scenes of a dataset's config; ``board`` and ``mesh`` need a config of one scene (see ``Views``)."""

    source: DatasetConfig

    @property
    def config(self) -> str:
        """Name of the config, with split and scene if it has several scenes."""
        return self.source.label

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

    @property
    def has_poses(self) -> bool:
        """Whether all views of a scene have poses in its world frame."""
        return self.source.imported is None or self.source.imported.has_poses

    @property
    def rectify(self) -> bool:
        """False: on the raw grid of a config, methods see what the camera sees."""
        return False

    @property
    def identity(self) -> list[str]:
        """Key of the build and digest of the ground truth."""
        return [self.source.key, self.source.ground_truth_digest]

    def by_scene(self) -> tuple[ConfigViews, ...]:
        """Return the views of each scene."""
        return tuple(map(ConfigViews, self.source.by_scene()))

    def check_columns(self, columns: Sequence[str], reader: str) -> None:
        """Raise ``DatasetError`` if ``reader`` needs columns that the config lacks."""
        check_columns(self.source, columns, reader)

    def rows(self, *columns: str, skip: Collection[str] = ()) -> Iterator[dict[str, Any]]:
        """Yield the decoded ``view_id`` and named columns of each view that is not in ``skip``, in order.

        Raises ``DatasetError`` for columns that the config lacks.
        """
        self.check_columns(columns, "the method")
        decoder = RowDecoder.of(self.source)
        for row in iterate_undecoded(self.source, ("view_id", *columns)):
            if row["view_id"] not in skip:
                yield decoder.row(row)
