"""The columns of a dataset row and how ``datasets`` is told of them."""

from __future__ import annotations

from datasets import Features, Image, List, Value

EYES = ("left", "right")


def _matrix(rows: int, columns: int) -> List:
    return List(List(Value("float64"), length=columns), length=rows)


def features(*, decode_images: bool = True) -> Features:
    """Return the features of a row, in the order of the contract's table.

    ``decode_images=False`` leaves image columns as their encoded bytes.
    """
    image = Image(decode=decode_images)
    columns: dict[str, object] = {"view_id": Value("string")}
    for kind, feature in (("rgb", image), ("depth", Value("binary")), ("mask", image), ("bars", image)):
        columns |= {f"{eye}_{kind}": feature for eye in EYES}
    columns["left_preview"] = image
    columns |= {f"{eye}_K": _matrix(3, 3) for eye in EYES}
    columns |= {f"{eye}_distortion": List(Value("float64"), length=5) for eye in EYES}
    columns |= {f"{eye}_cam_from_world": _matrix(4, 4) for eye in EYES}
    columns["baseline_m"] = Value("float64")
    return Features(columns)


COLUMN_MEANINGS: dict[str, str] = {
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
"""What a column holds, by its name or its kind (the name without the eye)."""


def column_kind(name: str) -> str:
    """Return a column's kind: its name without the eye it belongs to."""
    eye, _, kind = name.partition("_")
    return kind if eye in EYES else name
