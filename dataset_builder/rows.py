"""A rendered view, and the row of the dataset it becomes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Float32, Float64, UInt8, UInt16
from numpy import ndarray

from rebar_depth_bench import codecs
from rebar_depth_bench.colormap import depth_preview
from rebar_depth_bench.digests import eye_digest
from rebar_depth_bench.folder import ViewRecord
from rebar_depth_bench.protocol import scored_pixels
from rebar_depth_bench.schema import features


@dataclass(frozen=True, eq=False)
class Eye:
    """What one camera of a stereo view sees, and the camera itself."""

    rgb: UInt8[ndarray, "h w 3"]
    depth_m: Float32[ndarray, "h w"]
    mask: Bool[ndarray, "h w"]
    bars: UInt16[ndarray, "h w"]
    K: Float64[ndarray, "3 3"]
    distortion: Float64[ndarray, 5]
    cam_from_world: Float64[ndarray, "4 4"]


@dataclass(frozen=True, eq=False)
class View:
    """One stereo view of a config."""

    view_id: str
    left: Eye
    right: Eye
    baseline_m: float


def encode_view(view: View) -> tuple[pa.Table, ViewRecord]:
    """Return a view as a table of one row in the dataset's schema, and its record for the manifest."""
    cells: dict[str, Any] = {"view_id": view.view_id, "baseline_m": view.baseline_m}
    for name, eye in (("left", view.left), ("right", view.right)):
        cells |= {f"{name}_{kind}": cell for kind, cell in _eye_cells(eye).items()}
    cells["left_preview"] = _image(codecs.encode_palette(*depth_preview(view.left.depth_m)))
    schema = features().arrow_schema
    return pa.Table.from_pylist([cells], schema=schema), _record(view)


def _eye_cells(eye: Eye) -> dict[str, Any]:
    return {
        "rgb": _image(codecs.encode_rgb(eye.rgb)),
        "depth": codecs.encode_depth(eye.depth_m),
        "mask": _image(codecs.encode_mask(eye.mask)),
        "bars": _image(codecs.encode_bars(eye.bars)),
        "K": eye.K.tolist(),
        "distortion": eye.distortion.tolist(),
        "cam_from_world": eye.cam_from_world.tolist(),
    }


def _image(content: bytes) -> dict[str, bytes | None]:
    return {"bytes": content, "path": None}


def _record(view: View) -> ViewRecord:
    left = view.left
    return ViewRecord(
        view_id=view.view_id,
        left=_digest(left),
        right=_digest(view.right),
        steel_px=int(np.count_nonzero(left.mask)),
        scored_px=len(scored_pixels(left.mask, left.depth_m)),
    )


def _digest(eye: Eye) -> str:
    return eye_digest(eye.depth_m, eye.mask, eye.bars, eye.K, eye.distortion, eye.cam_from_world)
