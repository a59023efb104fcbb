"""Images of labels of other programs: steel masks and bar ids."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from jaxtyping import Shaped, UInt16
from numpy import ndarray

from dataset_builder.importing.depth_maps import Grid, check_grid, read_content, read_pixels
from rebar_depth_bench.errors import EntryError, Problem, escape_text

_IMAGE_FORMATS = {".png": "PNG", ".tif": "TIFF", ".tiff": "TIFF"}
LABEL_SUFFIXES = (*_IMAGE_FORMATS, ".npy")
_MAX_BAR_ID = np.iinfo(np.uint16).max


def read_labels(path: Path, grid: Grid) -> Shaped[ndarray, "h w"]:
    """Return the values of an image of labels of ``grid`` (height, width).

    Raises ``EntryError`` for a damaged file, another size, and values that are not whole numbers.
    """
    content, suffix = read_content(path, "an image of labels"), path.suffix.lower()
    values = _npy(path, content) if suffix == ".npy" else read_pixels(path, content, _IMAGE_FORMATS[suffix])
    check_grid(path, values, grid)
    if values.dtype.kind not in "bui":
        raise EntryError(Problem("invalid", path.name, f"has values of type {values.dtype}", "whole numbers"))
    return values


def bar_ids(path: Path, values: Shaped[ndarray, "h w"]) -> UInt16[ndarray, "h w"]:
    """Return labels as bar ids. Raises ``EntryError`` for values outside of 0 to 65535."""
    if values.min() < 0 or values.max() > _MAX_BAR_ID:
        found = f"has ids from {values.min()} to {values.max()}"
        raise EntryError(Problem("invalid", path.name, found, f"0 to {_MAX_BAR_ID}"))
    return values.astype(np.uint16)


def _npy(path: Path, content: bytes) -> ndarray:
    try:
        return np.asarray(np.load(io.BytesIO(content), allow_pickle=False))
    except Exception as error:  # NumPy raises many types, which depend on the damage.
        reason = escape_text(str(error) or type(error).__name__)
        raise EntryError(Problem("damaged", path.name, f"cannot be read: {reason}", "an array")) from None
