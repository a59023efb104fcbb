"""Loading of configs through ``datasets``, with rows of NumPy arrays or in other formats of ``datasets``."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

from rebar_depth_bench.base.errors import DatasetError, InputError, OutputError, escape_text
from rebar_depth_bench.base.names import TEST_SPLIT
from rebar_depth_bench.data.codecs import PICTURE_KINDS
from rebar_depth_bench.data.manifest import DatasetConfig, open_folder
from rebar_depth_bench.data.rows import decode_cell, image_cell
from rebar_depth_bench.data.schema import COLUMNS, column_kind, validated_columns
from rebar_depth_bench.data.shards import check_shards, shard_rows

if TYPE_CHECKING:
    from datasets import Dataset, IterableDataset

_CACHE_VERSION = 2
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
    float64 4 x 4. Colour is None in a config that was built without colour, and in an imported config every column
    that it lacks is None. ``split`` may be a part of a split, as ``"test[:10]"`` or ``"test[50%:]"``. ``columns``
    selects columns; the others are not decoded. With ``streaming`` the result is an ``IterableDataset``, and
    nothing is copied to the cache of ``datasets``.

    Image columns are ``datasets.Image``. A ``Dataset`` has the format ``numpy``; ``with_format("torch")`` makes
    tensors, and ``with_format(None)`` and ``with_transform`` give pictures of Pillow, and matrices as lists.

    Raises ``DatasetError`` for a folder, config, split or column that does not exist, for a damaged shard, and for
    a cell that contradicts the manifest; a damaged image raises it when its row is read. The cells of a streamed
    dataset are checked while it is read. Raises ``OutputError`` if the cache cannot be written, and ``InputError``
    if the installed ``datasets`` or a codec of Pillow does not suffice.
    """
    from datasets import Dataset, IterableDataset, NamedSplit, __version__

    from rebar_depth_bench.data.decoding_features import decoding_features

    whole = split.partition("[")[0] if isinstance(split, str) and split.endswith("]") else split
    located = open_folder(root).config(config).of_split(whole)
    part = None if split == whole else _part(located, split)
    selected = validated_columns(columns)
    check_shards(located)
    if streaming:
        try:
            streamed = IterableDataset.from_generator(
                _rows_with_images,
                features=decoding_features(selected, to_arrays=True),
                gen_kwargs={"config": located, "columns": selected, "shards": list(located.shards)},
                split=NamedSplit(whole),
            )
        except OSError as error:  # ``datasets`` makes its folder and a lock file.
            raise _cache_error(located, error) from error
        return streamed if part is None else streamed.skip(part.start).take(len(part))
    if tuple(map(int, __version__.split(".")[:2])) < (5, 1):  # Matrices would be arrays of Python objects.
        raise InputError(
            f"datasets {__version__} is installed, expected 5.1 or later: pip install 'datasets>=5.1'"
        )

    # The first call copies the rows to the cache of ``datasets``, which is mapped into memory. The key of the copy
    # covers the manifest's entry of the config, and place, size and time of the shards. ``datasets`` never reads
    # README.md, whose ``data_files`` could be any files.
    files = [located.file(shard).absolute() for shard in located.shards]
    stamps = [(str(file), file.stat().st_size, file.stat().st_mtime_ns) for file in files]
    key = json.dumps([_CACHE_VERSION, located.root, whole, stamps, located.manifest_entry], sort_keys=True)
    try:
        loaded = Dataset.from_generator(
            _rows_with_images,
            features=decoding_features(COLUMNS),
            gen_kwargs={"config": located, "columns": COLUMNS, "shards": list(located.shards)},
            split=NamedSplit(whole),
            fingerprint=hashlib.sha256(key.encode()).hexdigest()[:32],
            config_name=located.name,
            writer_batch_size=_ROWS_IN_MEMORY,
        ).select_columns(list(selected))
    except Exception as error:  # ``datasets`` wraps what reading a shard raises, which is an ``InputError``.
        cause = error.__cause__ or error
        if isinstance(cause, InputError):
            raise cause from error
        if isinstance(cause, OSError):
            raise _cache_error(located, cause) from error
        raise
    loaded.info.features = decoding_features(selected)  # A cached copy has features of ``datasets``.
    formatted = loaded.with_format("numpy")
    return formatted if part is None else formatted.select(part)


def _part(config: DatasetConfig, split: str) -> range:
    """Return the positions of ``split``, a part as ``test[:10]``. Raises ``DatasetError`` if it is not one."""
    from datasets import ReadInstruction

    try:
        [part] = ReadInstruction.from_spec(split).to_absolute({config.scenes[0].split: len(config.views)})
        return range(part.from_, part.to)
    except Exception as error:  # ``datasets`` asserts some properties of a part.
        found = f"{config.root}: {escape_text(split)} is no part of a split: {error}"
        raise DatasetError(f"{found}; expected one as test[:10] or test[50%:]") from None


def _rows_with_images(
    config: DatasetConfig, columns: Sequence[str], shards: Sequence[str]
) -> Iterator[dict[str, Any]]:
    """Yield the rows of shards, with images encoded for ``datasets.Image``; all other cells are checked."""
    for row in shard_rows(config, ("view_id", *columns), shards):
        view_id = str(row["view_id"])
        for column, cell in row.items():
            if column_kind(column) in PICTURE_KINDS and column not in config.absent_columns:
                row[column] = image_cell(config, column, cell, view_id)
            else:
                decode_cell(config, column, cell, view_id)
        yield {column: row[column] for column in columns}


def _cache_error(config: DatasetConfig, error: BaseException) -> OutputError:
    from datasets.config import HF_DATASETS_CACHE

    return OutputError(
        f"{HF_DATASETS_CACHE}: cannot be used as the cache of {config.name}: {escape_text(str(error))}; set "
        "HF_DATASETS_CACHE or HF_HOME to another folder; streaming=True needs a folder, but no space"
    )
