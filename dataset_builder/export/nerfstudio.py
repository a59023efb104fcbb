"""nerfstudio's ``transforms.json``, and line-oriented JSON output.

Source: nerfstudio's documentation, "Data conventions", and its ``Nerfstudio`` data parser. Cameras look along -z
with y up (OpenGL). Pixel coordinates are those of pixel centres, the first being (0.5, 0.5): nerfstudio's
``get_image_coords`` adds 0.5, and it subtracts 0.5 from cx and cy before it calls OpenCV. k1 k2 k3 p1 p2 are
OpenCV's.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from dataset_builder.export.colmap import HALF_PIXEL
from dataset_builder.export.images import EXPORT_FILES, MILLIMETRE_M
from dataset_builder.export.views import CameraView
from rebar_depth_bench.geometry.cameras import Camera, inverse_rigid, swap_camera_axes

_EMPTY_END = "[]\n}"
"""End of a JSON object whose last member is an empty list."""


def json_lines(head: Mapping[str, Any], name: str, entries: Sequence[Mapping[str, Any]]) -> str:
    """Return ``head`` as a JSON object with an additional member ``name``: the list of ``entries``, one per line.

    The result is readable: a short head, then a long list.
    """
    head_text = json.dumps({**head, name: []}, indent=1, allow_nan=False).removesuffix(_EMPTY_END)
    lines = ",\n".join(json.dumps(entry, allow_nan=False) for entry in entries)
    return f"{head_text}[\n{lines}\n]}}\n"


def transforms_json(views: Sequence[CameraView]) -> str:
    """Return ``transforms.json``; intrinsics are at the top level if all frames share them, else in each frame."""
    frames = [(view.stem(eye), camera) for view in views for eye, camera in view.cameras.items()]
    intrinsics = [_intrinsics(camera) for _, camera in frames]
    shared = intrinsics[0] if all(entry == intrinsics[0] for entry in intrinsics) else None
    head = {"camera_model": "OPENCV", "depth_unit_scale_factor": MILLIMETRE_M, **(shared or {})}
    entries = [
        {**_frame(stem, camera), **({} if shared else own)}
        for (stem, camera), own in zip(frames, intrinsics, strict=True)
    ]
    return json_lines(head, "frames", entries)


def _frame(stem: str, camera: Camera) -> dict[str, Any]:
    """Return the file names and the pose of one frame."""
    return {
        "file_path": EXPORT_FILES["image"].path(stem),
        "mask_path": EXPORT_FILES["mask"].path(stem),
        "depth_file_path": EXPORT_FILES["depth_mm"].path(stem),
        "transform_matrix": inverse_rigid(swap_camera_axes(camera.cam_from_world)).tolist(),
    }


def _intrinsics(camera: Camera) -> dict[str, float]:
    """Return nerfstudio's intrinsics of a camera."""
    K = camera.K
    focal = {"fl_x": float(K[0, 0]), "fl_y": float(K[1, 1])}
    centre = {"cx": float(K[0, 2]) + HALF_PIXEL, "cy": float(K[1, 2]) + HALF_PIXEL}
    distortion = dict(zip(("k1", "k2", "p1", "p2", "k3"), camera.distortion.tolist(), strict=True))
    return {**focal, **centre, "w": camera.width, "h": camera.height, **distortion}
