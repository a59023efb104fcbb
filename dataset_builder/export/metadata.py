"""Metadata of an exported folder: ``cameras.json`` for programs and ``README.txt`` for people."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dataset_builder.export.camera_formats import json_lines
from dataset_builder.export.exported_views import CameraView, exported_files
from rebar_depth_bench.data.manifest import DatasetConfig, DatasetFolder
from rebar_depth_bench.geometry.cameras import Camera

LICENCE = "CC BY 4.0 (https://creativecommons.org/licenses/by/4.0/)"
"""Licence of the dataset."""

CONVENTIONS = {
    "axes": "OpenCV: x to the right, y down, z forward along the optical axis",
    "pixels": "u along the width, v along the height; the middle of the first pixel is (0, 0)",
    "length": "metres",
    "world": "right-handed, z up, the board or the ground at z = 0",
    "K": "3 x 3 pinhole matrix, pixels",
    "distortion": "k1 k2 p1 p2 k3 as in OpenCV, zeros where the picture has none",
    "cam_from_world": "4 x 4 rigid: x_cam = cam_from_world @ x_world",
    "depth": "planar: along the optical axis, not along the ray; 0 where there is no surface",
    "baseline_m": "from the left to the right camera along the left one's x axis",
}
"""Descriptions of units and frames, part of ``cameras.json``."""

_NOT_PARAMETERS = ("shards", "key", "mesh", "bytes")
"""Keys of a scene's manifest entry that are not its parameters."""


def cameras_json(folder: DatasetFolder, config: DatasetConfig, views: Sequence[CameraView]) -> str:
    """Return ``cameras.json``: conventions, origin of the data, and one entry per view and eye."""
    parameters = {**config.scene.entry, "colour": config.manifest_entry["colour"]}
    head = {
        "conventions": CONVENTIONS,
        "dataset": {"digest": folder.digest, "version": folder.version},
        "config": config.name,
        **({"split": config.scene.split, "scene": config.scene.name} if config.has_splits else {}),
        "parameters": {name: value for name, value in parameters.items() if name not in _NOT_PARAMETERS},
        "licence": LICENCE,
    }
    cameras = [_camera(config, view, eye, camera) for view in views for eye, camera in view.cameras.items()]
    return json_lines(head, "cameras", cameras)


def _camera(config: DatasetConfig, view: CameraView, eye: str, camera: Camera) -> dict[str, Any]:
    """Return the entry of one eye of a view."""
    return {
        "view_id": view.view_id,
        "eye": eye,
        "width": camera.width,
        "height": camera.height,
        "K": camera.K.tolist(),
        "distortion": camera.distortion.tolist(),
        "cam_from_world": camera.cam_from_world.tolist(),
        "baseline_m": view.baseline_m,
        **{name: export_file.path(view.stem(eye)) for name, export_file in exported_files(config).items()},
    }


def readme_txt(folder: DatasetFolder, config: DatasetConfig, views: int) -> str:
    """Return ``README.txt``: the content, unit and frame of each file."""
    return _README.format(
        config=config.label,
        views=views,
        digest=folder.digest,
        version=folder.version,
        no_colour=_NO_COLOUR if config.colour is None else "",
        licence=LICENCE,
    )


_NO_COLOUR = """
This config was built without colour: images/, sparse/ and transforms.json do not exist.
"""


_README = """\
rebar-depth-bench, config {config}: {views} stereo views of steel reinforcement with exact depth
dataset {digest}, version {version}
{no_colour}
Files, NNNN being the view's number in its full protocol, left and right the eye:
  images/NNNN_left.png    8-bit colour, lossless
  depth/NNNN_left.exr     OpenEXR, one float32 channel "Y": metres, exact, 0 where there is no surface
  depth_mm/NNNN_left.png  the same in 16 bits, ROUNDED to whole millimetres; 0 also beyond 65.535 m
  masks/NNNN_left.png     8-bit: 255 on steel, 0 elsewhere
  bars/NNNN_left.png      16-bit: the bar's number, 0 where no steel
  cameras.json            intrinsics, distortion, poses and file names of every picture
  sparse/0/*.txt          the true cameras as a COLMAP text model
  transforms.json         the true cameras for nerfstudio

Conventions of cameras.json
  Metres. World: right-handed, z up, the board or the ground at z = 0.
  Camera: OpenCV axes (x right, y down, z forward), x_cam = cam_from_world @ x_world.
  The middle of the first pixel is (0, 0). Distortion: k1 k2 p1 p2 k3 as in OpenCV.
  Depth is planar: the distance along the optical axis, not along the pixel's ray.

COLMAP
  Same axes and metres. The middle of the first pixel is (0.5, 0.5) there: cx and cy are larger by 0.5.
  PINHOLE cameras, FULL_OPENCV where the pictures are distorted. The points lie on the bars' centrelines; no
  picture observes them. masks/ serves as mask_path: COLMAP then takes features on steel alone.

nerfstudio
  OpenGL axes (y up, z backwards); the middle of the first pixel is (0.5, 0.5). depth_file_path is the depth
  rounded to millimetres, the unit nerfstudio expects (depth_unit_scale_factor 0.001). mask_path is the steel
  mask: nerfstudio learns from steel pixels alone; remove the mask_path entries to learn the whole picture. To
  keep metres and this world frame: --orientation-method none --center-method none --auto-scale-poses False.

OpenCV reads the depth with OPENCV_IO_ENABLE_OPENEXR=1 in the environment:
  cv2.imread("depth/NNNN_left.exr", cv2.IMREAD_UNCHANGED)

Licence: {licence}
"""
