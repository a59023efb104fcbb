"""``transforms.json`` for nerfstudio.

Source: nerfstudio's documentation, "Data conventions", and its ``Nerfstudio`` data parser. Cameras look along -z
with y up (OpenGL); a pixel's coordinates are those of its centre, the first being (0.5, 0.5): its
``get_image_coords`` adds 0.5, and it takes 0.5 off cx and cy before it calls OpenCV. k1 k2 k3 p1 p2 are OpenCV's.

JSON that people can read: a short head, then a long list with one entry a line.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.config.rigs import Camera
from dataset_builder.export.colmap import HALF_PIXEL
from dataset_builder.export.images import MILLIMETRE_M, PICTURES
from dataset_builder.export.views import CameraView
from rebar_depth_bench.geometry.cameras import inverse_rigid

_EMPTY_END = "[]\n}"


def json_lines(head: Mapping[str, Any], name: str, entries: Sequence[Mapping[str, Any]]) -> str:
    """Return ``head`` as a JSON object with one more member ``name``: the list of ``entries``, a line each."""
    outline = json.dumps({**head, name: []}, indent=1, allow_nan=False).removesuffix(_EMPTY_END)
    lines = ",\n".join(json.dumps(entry, allow_nan=False) for entry in entries)
    return f"{outline}[\n{lines}\n]}}\n"


_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def transforms_json(views: Sequence[CameraView]) -> str:
    """Return ``transforms.json``; intrinsics stand at the top if all frames share them, else in each frame."""
    frames = [(view.stem(eye), camera) for view in views for eye, camera in view.cameras.items()]
    intrinsics = [_intrinsics(camera) for _, camera in frames]
    shared = intrinsics[0] if all(one == intrinsics[0] for one in intrinsics) else None
    head = {"camera_model": "OPENCV", "depth_unit_scale_factor": MILLIMETRE_M, **(shared or {})}
    entries = [
        {**_frame(stem, camera), **({} if shared else own)}
        for (stem, camera), own in zip(frames, intrinsics, strict=True)
    ]
    return json_lines(head, "frames", entries)


def world_from_opengl_cam(cam_from_world: Float64[ndarray, "4 4"]) -> Float64[ndarray, "4 4"]:
    """Return the pose of a camera in OpenGL axes (x right, y up, z backwards) from our ``cam_from_world``."""
    return np.asarray(inverse_rigid(cam_from_world) @ _OPENCV_FROM_OPENGL)


def _frame(stem: str, camera: Camera) -> dict[str, Any]:
    return {
        "file_path": PICTURES["image"].path(stem),
        "mask_path": PICTURES["mask"].path(stem),
        "depth_file_path": PICTURES["depth_mm"].path(stem),
        "transform_matrix": world_from_opengl_cam(camera.cam_from_world).tolist(),
    }


def _intrinsics(camera: Camera) -> dict[str, float]:
    K = camera.K
    focal = {"fl_x": float(K[0, 0]), "fl_y": float(K[1, 1])}
    centre = {"cx": float(K[0, 2]) + HALF_PIXEL, "cy": float(K[1, 2]) + HALF_PIXEL}
    distortion = dict(zip(("k1", "k2", "p1", "p2", "k3"), camera.distortion.tolist(), strict=True))
    return {**focal, **centre, "w": camera.width, "h": camera.height, **distortion}
