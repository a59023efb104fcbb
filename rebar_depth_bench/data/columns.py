"""Columns of a dataset row: names, descriptions, ``datasets`` features and Arrow schema."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import pyarrow as pa

from rebar_depth_bench.errors import DatasetError

if TYPE_CHECKING:
    from datasets import Features

EYES = ("left", "right")
COLUMNS = (
    "view_id",
    "scene",
    *(f"{eye}_{kind}" for kind in ("rgb", "depth", "mask", "bars") for eye in EYES),
    "left_preview",
    *(f"{eye}_{kind}" for kind in ("K", "distortion", "cam_from_world") for eye in EYES),
    "baseline_m",
)
"""Names of the columns, in order."""
OPTIONAL_COLUMNS = (
    *("left_rgb", "left_mask", "left_bars"),
    *(name for name in COLUMNS if name.startswith("right_") or name == "baseline_m"),
)
"""Columns that may be null in every row of a config that was imported; K, distortion and pose are NaN then."""


def features() -> Features:
    """Return the ``datasets`` features of the shards' rows, in column order."""
    from datasets import Features, Image, List, Value  # Takes a second to import, which scoring does not need.

    image, number = Image(), Value("float64")
    by_kind = {
        **dict.fromkeys(("view_id", "scene"), Value("string")),
        **dict.fromkeys(("rgb", "mask", "bars", "preview"), image),
        "depth": Value("binary"),
        "K": List(List(number, length=3), length=3),
        "distortion": List(number, length=5),
        "cam_from_world": List(List(number, length=4), length=4),
        "baseline_m": number,
    }
    return Features({name: by_kind[column_kind(name)] for name in COLUMNS})


COLUMN_DESCRIPTIONS: dict[str, str] = {
    "view_id": "`<config>/<0000>`: the view's index in its full protocol, also when a subset is built; "
    "`<config>/<split>-<scene>-<0000>` in configs of several scenes",
    "scene": "name of the scene, as in `bars.parquet` and `meshes/`",
    "rgb": "lossless 8-bit colour, H x W, WebP; null in every row of a config built without colour",
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
    **dict.fromkeys(("view_id", "scene"), pa.string()),
    **dict.fromkeys(("rgb", "mask", "bars", "preview"), _IMAGE_CELL),
    "depth": pa.binary(),
    "K": pa.list_(pa.list_(pa.float64(), 3), 3),
    "distortion": pa.list_(pa.float64(), 5),
    "cam_from_world": pa.list_(pa.list_(pa.float64(), 4), 4),
    "baseline_m": pa.float64(),
}
ROW_SCHEMA = pa.schema([(name, _ARROW_TYPES[column_kind(name)]) for name in COLUMNS])
"""Arrow schema of ``features``, without its metadata."""


def validated_columns(columns: Sequence[str] | None) -> tuple[str, ...]:
    """Return the names of columns as a tuple, all of them for None. Raises ``DatasetError`` for unknown names."""
    if columns is None:
        return COLUMNS
    if isinstance(columns, str):
        raise DatasetError(f"columns is {columns!r}, expected a list of column names")
    unknown = [name for name in columns if name not in COLUMNS]
    if unknown:
        raise DatasetError(f"no column {', '.join(map(repr, unknown))}, expected some of {', '.join(COLUMNS)}")
    return tuple(columns)
