"""Random crops and horizontal flips of dataset rows for training, with consistent depth, masks, K and poses.

A flip mirrors the images of a view. Depth is unchanged but for its place, the principal point moves from ``cx`` to
``W - 1 - cx``, and the pose is followed by a reflection of the camera's x axis, so that ``K`` and the pose still
project world points to where the mirrored images show them. A mirrored stereo pair has its eyes exchanged: the
mirrored right view is the left one of a pair with the same baseline.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any
from zlib import crc32

import numpy as np

from rebar_depth_bench.data.columns import EYES, column_kind
from rebar_depth_bench.errors import InputError, Problem

Row = Mapping[str, Any]

IMAGE_KINDS = ("rgb", "depth", "mask", "bars")
"""Kinds of columns that hold an image of a view, H x W or H x W x 3."""

_MIRROR_X = np.diag([-1.0, 1.0, 1.0, 1.0])
FLIP_PROBABILITY = 0.5


@dataclass(frozen=True)
class Augmentation:
    """Random changes of rows: crops of ``crop`` (height, width) pixels, None for none, and flips of half the rows.

    They depend on ``seed``, the epoch and the view id only, not on the order of rows or the number of workers.
    """

    crop: tuple[int, int] | None = None
    flip: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        """Raise ``InputError`` for a crop that is empty and for a seed below 0."""
        problems = []
        if self.crop is not None and (len(self.crop) != 2 or min(self.crop) < 1):
            problems.append(
                Problem("invalid", "crop", f"got {self.crop}", "height and width in pixels, 1 or more")
            )
        if self.seed < 0:
            problems.append(Problem("invalid", "seed", f"got {self.seed}", "0 or more"))
        if problems:
            raise InputError.from_problems("augmentation", problems)

    def __call__(self, row: Row, epoch: int) -> Row:
        """Return a row with ``view_id`` as changed in an epoch.

        Raises ``InputError`` if the crop is larger than the image, and as ``flip_row``.
        """
        rng = np.random.default_rng([self.seed, epoch, crc32(row["view_id"].encode())])
        if self.crop is not None:
            row = crop_row(row, self.crop, rng)
        is_flipped = self.flip and rng.random() < FLIP_PROBABILITY
        return flip_row(row) if is_flipped else row


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

    Raises ``InputError`` if it has an image of one eye only that the row should have of both.
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
        flipped[name] = None if source is None else _mirrored(source, kind, width)
    return flipped


def _mirrored(value: Any, kind: str, width: int) -> Any:
    """Return the value of a column of one eye for the mirrored image of ``width`` pixels."""
    if kind in IMAGE_KINDS:
        return value[:, ::-1]
    if kind == "cam_from_world":
        return _MIRROR_X @ value
    if kind == "K":
        K = np.array(value)
        K[0, 2] = width - 1 - K[0, 2]
        return K
    raise ValueError(f"columns of kind {kind!r} cannot be mirrored, expected images, K or cam_from_world")


def _is_image(row: Row, name: str) -> bool:
    return column_kind(name) in IMAGE_KINDS and row[name] is not None
