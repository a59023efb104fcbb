"""Batches of tensors for training: a PyTorch loader of dataset rows, and geometric augmentation of a row."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from operator import index
from typing import Any
from zlib import crc32

import numpy as np
import PIL.Image
from datasets import Dataset, Image, IterableDataset, Value

from rebar_depth_bench.base.errors import DatasetError, InputError, MethodError, Problem, install_command
from rebar_depth_bench.data.codecs import PICTURE_KINDS
from rebar_depth_bench.data.decoding_features import STORED_MODES
from rebar_depth_bench.data.rows import is_absent
from rebar_depth_bench.data.schema import EYES, column_kind

try:
    import torch
    from torch.utils.data import DataLoader, RandomSampler, Sampler, get_worker_info
    from torch.utils.data import Dataset as TorchDataset
    from torch.utils.data import IterableDataset as TorchIterableDataset
except ImportError as error:
    raise MethodError(f"torch_loader needs torch ({error}): {install_command('torch')}") from None

Row = Mapping[str, Any]
Batch = dict[str, Any]

SHUFFLE_BUFFER = 32
"""Views of a streamed dataset among which the next one is drawn."""
FLIP_PROBABILITY = 0.5
_MOST_WORKERS = 1024
_NUMBER_KINDS = ("K", "cam_from_world", "baseline_m")
_MIRROR_X = np.diag([-1.0, 1.0, 1.0, 1.0])
_LEFT = {
    "rgb": "left_rgb",
    "depth": "left_depth",
    "mask": "left_mask",
    "K": "left_K",
    "poses": "left_cam_from_world",
}
"""Column of each key of a batch."""
_RIGHT = {f"right_{key}": column.replace("left", "right") for key, column in _LEFT.items()}


def torch_loader(
    ds: Dataset | IterableDataset,
    batch_size: int = 1,
    num_workers: int = 0,
    *,
    shuffle: bool = False,
    sampler: Sampler[int] | Iterable[int] | None = None,
    drop_last: bool = False,
    pin_memory: bool = False,
    stereo: bool = False,
    crop: int | tuple[int, int] | None = None,
    flip: bool = False,
    seed: int = 0,
) -> DataLoader[Batch]:
    """Return a ``DataLoader`` over a dataset returned by ``load``, streaming or not, or by ``load_dataset``.

    A batch is a dict: ``rgb`` uint8 B x 3 x H x W, ``depth`` float32 B x 1 x H x W (planar, metres, 0 where there
    is no surface), ``mask`` bool B x 1 x H x W, ``K`` float64 B x 3 x 3 (pixels), ``poses`` float64 B x 4 x 4
    (``cam_from_world``), all of the left view, and ``view_id``, a list of str. With ``stereo`` the batch also has
    the same keys of the right view, prefixed ``right_``, and ``baseline_m`` float64 B. Batches of a config without
    colour lack ``rgb`` and ``right_rgb``, and batches of an imported config lack what the config lacks.

    Columns that a batch does not need are not decoded. The format of ``ds`` makes no difference, but a transform
    is applied. A dataset that only ``datasets`` has read is not compared with the manifest.

    For training, ``shuffle`` changes the order in every epoch. A streamed dataset is shuffled by shard, and then
    in a buffer of 32 views (``SHUFFLE_BUFFER``). ``crop``, (height, width) or the side of a square in pixels,
    takes a random part of each view, and ``flip`` mirrors half of the views. Depth, masks, K and poses stay
    consistent: a flipped stereo pair has its eyes exchanged, and the pose of a flipped view contains the
    reflection. Crops and flips depend on ``seed``, the view id and how often the view was drawn before (of a
    streamed dataset: how often it was iterated), not on the order, the sampler or the number of workers. Views
    that workers drew ahead of an interruption count too. The order of shuffled views depends on ``seed`` and how
    often the loader was iterated, and for a streamed dataset also on torch's seed and the number of workers.

    ``sampler``, ``drop_last`` and ``pin_memory`` are arguments of ``DataLoader``. A sampler takes the place of
    ``shuffle``, and a streamed dataset has none; the caller sets the epoch of a ``DistributedSampler``. Training
    frameworks may build the loader again from its ``dataset`` and ``collate_fn``, with a sampler of their own.

    Importing this module without torch raises ``MethodError``. Raises ``InputError`` for arguments of other types,
    and for a sampler beside ``shuffle`` or with a streamed dataset, and ``DatasetError`` if ``ds`` lacks columns.
    """
    if not isinstance(ds, (Dataset, IterableDataset)):
        raise DatasetError(f"got a {type(ds).__name__}, expected one split, as rdb.load(ROOT, CONFIG) returns it")
    keys = {**_LEFT, **_RIGHT, "baseline_m": "baseline_m"} if stereo else _LEFT
    columns = ["view_id", *keys.values()]
    missing = [name for name in columns if ds.column_names is not None and name not in ds.column_names]
    if missing:
        found = f"the dataset lacks the columns {', '.join(missing)}"
        raise DatasetError(f"{found}, expected those that rdb.load(ROOT, CONFIG) returns")
    augmentation = Augmentation((crop, crop) if isinstance(crop, int | np.integer) else crop, flip, seed)
    is_streamed = isinstance(ds, IterableDataset)
    flags = {"shuffle": shuffle, "drop_last": drop_last, "pin_memory": pin_memory, "stereo": stereo}
    given = (
        ("batch_size", batch_size, _is_whole(batch_size, 1), "a whole number, 1 or more"),
        ("num_workers", num_workers, _is_whole(num_workers, 0), "a whole number, 0 or more"),
        ("sampler", sampler, isinstance(sampler, Iterable | None), "numbers of rows, which can be iterated"),
        *((name, flag, isinstance(flag, bool), "True or False") for name, flag in flags.items()),
    )
    problems = [
        Problem("invalid", name, f"got {value!r}", expected)
        for name, value, is_valid, expected in given
        if not is_valid
    ]
    if problems:
        raise InputError.from_problems("torch_loader", problems)
    if sampler is not None and (shuffle or is_streamed):
        found = "shuffle" if shuffle else "a streamed dataset, whose rows have no numbers"
        raise InputError(f"torch_loader: sampler is given with {found}, expected only one of both")

    # Images are decoded to pictures, or as a transform of the dataset decodes them.
    rows = ds.select_columns(columns)
    for name in columns:
        if rows.features is not None and rows.features[name] == Value("binary"):
            rows = rows.cast_column(name, Image(mode=STORED_MODES[column_kind(name)]))
    if is_streamed or rows.format["type"] != "custom":
        rows = rows.with_format(None)
    source: Any
    if is_streamed:
        source = _StreamedRows(rows, augmentation, shuffle=shuffle)
    else:
        source = _Rows(rows, augmentation)
        sampler = _SeededSampler(source, seed) if shuffle else sampler
    return DataLoader(
        source,
        batch_size=int(batch_size),  # torch takes no integers of NumPy.
        sampler=sampler,
        num_workers=num_workers,
        collate_fn=partial(_collated, keys),
        drop_last=drop_last,
        pin_memory=pin_memory,
    )


class _Rows(TorchDataset[Row]):
    """Rows of a dataset as arrays, with crops and flips."""

    def __init__(self, rows: Dataset, augmentation: Augmentation) -> None:
        self._rows, self._augmentation = rows, augmentation
        self._draws = _SharedCounts(torch.zeros(len(rows), dtype=torch.int64))

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, position: int) -> Row:
        return self._augmentation(_arrays(self._rows[index(position)]), self._draws.add(position))


class _SeededSampler(RandomSampler):
    """Order of rows, different in each epoch; it has no generator, which cannot be sent to spawned processes."""

    def __init__(self, rows: _Rows, seed: int) -> None:
        super().__init__(rows)
        self._seed = seed
        self._passes = 0

    def __iter__(self) -> Iterator[int]:
        rng = np.random.default_rng([self._seed, self._passes])
        self._passes += 1
        return iter(rng.permutation(len(self)).tolist())


class _StreamedRows(TorchIterableDataset[Row]):
    """Rows of a streamed dataset as arrays, with crops and flips; each worker reads other shards."""

    def __init__(self, rows: IterableDataset, augmentation: Augmentation, *, shuffle: bool) -> None:
        self._rows, self._augmentation, self._shuffle = rows, augmentation, shuffle
        self._passes = 0
        self._passes_of_workers = _SharedCounts(torch.zeros(_MOST_WORKERS, dtype=torch.int64))

    def __iter__(self) -> Iterator[Row]:
        worker = get_worker_info()
        # Workers divide the shards, so their orders must be equal: the seeds without the numbers of the workers
        # are, and the passes of persistent ones, which keep their seeds.
        torch_seed = worker.seed - worker.id if worker else torch.initial_seed()
        rng = np.random.default_rng([self._augmentation.seed, torch_seed, self._passes])
        self._passes += 1
        earlier = self._passes_of_workers.add(worker.id % _MOST_WORKERS if worker else 0)
        rows = self._rows.shuffle(generator=rng, buffer_size=SHUFFLE_BUFFER) if self._shuffle else self._rows
        for row in rows:
            yield self._augmentation(_arrays(row), earlier)


class _SharedCounts:
    """Counts in memory that a process shares with its workers, most of which live for one epoch."""

    def __init__(self, counts: torch.Tensor) -> None:
        self._counts = counts.share_memory_()  # type: ignore[no-untyped-call]

    def __reduce__(self) -> Any:
        return _SharedCounts, (self._counts,)  # Copies are shared with their workers too.

    def add(self, position: int) -> int:
        """Add one to a count and return the count before."""
        earlier = int(self._counts[position])
        self._counts[position] = earlier + 1
        return earlier


def _arrays(row: Row) -> Row:
    """Return a row with its images, matrices and numbers as arrays, and None for absent ones."""
    arrays = dict(row)
    for name, cell in row.items():
        kind = column_kind(name)
        if is_absent(cell):
            arrays[name] = None
        elif kind in _NUMBER_KINDS:
            arrays[name] = np.asarray(cell, dtype=np.float64)
        elif kind in PICTURE_KINDS:
            is_colour = kind == "rgb" and isinstance(cell, PIL.Image.Image)
            arrays[name] = np.asarray(cell.convert("RGB") if is_colour else cell, dtype=PICTURE_KINDS[kind].dtype)
    return arrays


def _collated(keys: Mapping[str, str], rows: Sequence[Row]) -> Batch:
    """Stack rows of arrays to tensors; ``keys`` maps the keys of the batch to columns."""
    batch: Batch = {}
    for key, column in keys.items():
        if rows[0][column] is None:
            continue
        tensor = torch.from_numpy(np.stack([row[column] for row in rows]))
        kind = key.removeprefix("right_")
        if kind == "rgb":
            tensor = tensor.permute(0, 3, 1, 2)  # A view: the memory stays channels last.
        elif kind in ("depth", "mask"):
            tensor = tensor[:, None]
        batch[key] = tensor
    batch["view_id"] = [row["view_id"] for row in rows]
    return batch


@dataclass(frozen=True)
class Augmentation:
    """Random changes of rows: crops of ``crop`` (height, width) pixels, or None, and flips of half of the rows.

    They depend only on ``seed``, the view id and how often the view was drawn before.
    """

    crop: tuple[int, int] | None = None
    flip: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        """Raise ``InputError`` for an empty crop, a flip that is not a bool, and a seed below 0."""
        problems = []
        is_pair = isinstance(self.crop, Sequence) and len(self.crop) == 2
        if self.crop is not None and not (is_pair and all(_is_whole(side, 1) for side in self.crop)):
            expected = "a side or (height, width) in pixels, whole numbers of 1 or more"
            problems.append(Problem("invalid", "crop", f"got {self.crop!r}", expected))
        if not isinstance(self.flip, bool):
            problems.append(Problem("invalid", "flip", f"got {self.flip!r}", "True or False"))
        if not _is_whole(self.seed, 0):
            problems.append(Problem("invalid", "seed", f"got {self.seed!r}", "a whole number, 0 or more"))
        if problems:
            raise InputError.from_problems("augmentation", problems)

    def __call__(self, row: Row, earlier_draws: int) -> Row:
        """Return a row with ``view_id``, changed as it is after ``earlier_draws`` of its view.

        Raises ``InputError`` if the crop is larger than the image, and if an eye lacks an image that the other
        has.
        """
        rng = np.random.default_rng([self.seed, earlier_draws, crc32(row["view_id"].encode())])
        if self.crop is not None:
            row = crop_row(row, self.crop, rng)
        is_flipped = self.flip and rng.random() < FLIP_PROBABILITY
        return flip_row(row) if is_flipped else row


def _is_whole(value: object, least: int) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and bool(value >= least)


def crop_row(row: Row, size: tuple[int, int], rng: np.random.Generator) -> Row:
    """Return a row with all images cropped to (height, width) at one random place, the same in both eyes.

    The principal points are relative to the crop: rectified pairs stay rectified, with the same disparities.
    Raises ``InputError`` if the crop is larger than the image.
    """
    height, width = next(row[name].shape[:2] for name in row if _is_image(row, name))
    if size[0] > height or size[1] > width:
        found, expected = f"got {size[0]} x {size[1]} (height x width)", f"at most {height} x {width}, the image"
        raise InputError.from_problems(f"view {row['view_id']}", [Problem("invalid", "crop", found, expected)])
    top, left = (int(rng.integers(whole - part + 1)) for whole, part in zip((height, width), size, strict=True))
    offset = np.array([[0.0, 0.0, left], [0.0, 0.0, top], [0.0, 0.0, 0.0]])
    cropped = dict(row)
    for name in row:
        if _is_image(row, name):
            cropped[name] = row[name][top : top + size[0], left : left + size[1]]
        elif column_kind(name) == "K" and row[name] is not None:
            cropped[name] = row[name] - offset
    return cropped


def flip_row(row: Row) -> Row:
    """Return a row with its images mirrored, and its eyes exchanged if it has columns of both.

    Raises ``InputError`` if an eye lacks an image that the other eye has.
    """
    eyes = [eye for eye in EYES if any(name.startswith(f"{eye}_") for name in row)]
    width = next(row[name].shape[1] for name in row if _is_image(row, name))
    flipped = dict(row)
    for name, value in row.items():
        eye, _, kind = name.partition("_")
        if eye not in EYES:
            continue
        source = row[f"{EYES[1 - EYES.index(eye)]}_{kind}"] if len(eyes) == len(EYES) else value
        if (source is None) != (value is None):
            problem = Problem("missing", kind, "the view has it for one eye only", "both eyes, to exchange them")
            raise InputError.from_problems(f"flip of view {row['view_id']}", [problem])
        if source is None:
            flipped[name] = None
        elif kind in PICTURE_KINDS:
            flipped[name] = source[:, ::-1]
        elif kind == "cam_from_world":
            flipped[name] = _MIRROR_X @ source
        elif kind == "K":
            flipped[name] = np.array(source)
            flipped[name][0, 2] = width - 1 - source[0, 2]
        else:
            raise ValueError(f"columns of kind {kind!r} cannot be mirrored, expected images, K or cam_from_world")
    return flipped


def _is_image(row: Row, name: str) -> bool:
    return column_kind(name) in PICTURE_KINDS and row[name] is not None
