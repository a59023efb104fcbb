"""Cameras and metadata for other programs: COLMAP, ``transforms.json``, ``cameras.json``, README, Ultralytics.

The centre of their first pixel is (0.5, 0.5), the centre of ours is (0, 0), so ``HALF_PIXEL`` is added to cx, cy.
Numbers have up to 17 digits, so that they are read back as the same float64.

COLMAP (its documentation, "Output Format" and "Camera Models"; files ``cameras.txt``, ``images.txt`` and
``points3D.txt``) uses OpenCV's camera axes. nerfstudio's cameras (its documentation, "Data conventions", and its
``Nerfstudio`` data parser) look along -z with y up, as OpenGL's: its ``get_image_coords`` adds 0.5, and it
subtracts 0.5 from cx and cy before it calls OpenCV. k1 k2 k3 p1 p2 are OpenCV's.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from dataset_builder.export.exported_views import EXPORT_FILES, MILLIMETRE_M, CameraView, exported_files
from dataset_builder.scene.shapes.bending import resample_polyline_m
from rebar_depth_bench.base.names import SPLITS
from rebar_depth_bench.captures.fields import LENS_TERMS
from rebar_depth_bench.data.bars import Bar, with_axis
from rebar_depth_bench.data.manifest import DatasetConfig, DatasetFolder
from rebar_depth_bench.geometry.cameras import HALF_PIXEL, Camera, inverse_rigid, swap_camera_axes

TARGET_POINT_COUNT = 10_000
"""Approximate number of points in ``points3D.txt``."""

_MIN_STEP_M = 0.001
"""Minimum distance of neighbouring points on a centreline, metres."""

_GREY = "128 128 128"
"""Colour of all points, R G B."""

_REPROJECTION_ERROR = "0"
"""Error column of ``points3D.txt``: no image observes the points."""


def cameras_txt(views: Sequence[CameraView]) -> str:
    """Return ``cameras.txt``: each distinct camera once, numbered from 1.

    Cameras without distortion are PINHOLE (fx fy cx cy), all others FULL_OPENCV
    (fx fy cx cy k1 k2 p1 p2 k3 0 0 0).
    """
    lines = [f"{camera_id} {camera_line}" for camera_line, camera_id in _camera_ids(views).items()]
    return _with_header("CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]", lines)


def images_txt(views: Sequence[CameraView]) -> str:
    """Return ``images.txt``: both eyes of every view, with ``cam_from_world`` as quaternion and translation.

    The second line of an image, which lists its feature points, is empty. Names are relative to ``images/``.
    """
    camera_ids = _camera_ids(views)
    lines: list[str] = []
    for view in views:
        for eye, camera in view.cameras.items():
            pose = camera.cam_from_world
            numbers = _format_floats([*quaternion_wxyz(pose[:3, :3]), *pose[:3, 3]])
            image_id = len(lines) // 2 + 1
            lines += [f"{image_id} {numbers} {camera_ids[_camera_line(camera)]} {view.stem(eye)}.png", ""]
    return _with_header("IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then POINTS2D[] as (X Y POINT3D_ID)", lines)


def points_txt(bars: Sequence[Bar]) -> str:
    """Return ``points3D.txt``: about ``TARGET_POINT_COUNT`` grey points on the bars' centrelines.

    No image observes them. Some tools (Gaussian splatting among them) initialise from the points and reject a
    model without any.
    """
    lines = [
        f"{number} {_format_floats(point)} {_GREY} {_REPROJECTION_ERROR}"
        for number, point in enumerate(axis_points_m(bars), start=1)
    ]
    return _with_header("POINT3D_ID X Y Z R G B ERROR TRACK[] as (IMAGE_ID POINT2D_IDX)", lines)


def axis_points_m(bars: Sequence[Bar]) -> Float64[ndarray, "n 3"]:
    """Return points spread evenly over each known centreline, including its ends; world frame, metres."""
    axes_m = [np.array(bar.axis_m, dtype=np.float64) for bar in with_axis(bars)]
    length_m = sum(float(np.linalg.norm(np.diff(axis_m, axis=0), axis=1).sum()) for axis_m in axes_m)
    step_m = max(length_m / TARGET_POINT_COUNT, _MIN_STEP_M)
    return np.concatenate([np.empty((0, 3)), *(resample_polyline_m(axis_m, step_m) for axis_m in axes_m)])


def quaternion_wxyz(rotation: Float64[ndarray, "3 3"]) -> Float64[ndarray, " 4"]:
    """Return the unit quaternion (w, x, y, z), w >= 0, of a rotation matrix."""
    return np.asarray(np.roll(Rotation.from_matrix(rotation).as_quat(canonical=True), 1))


def _camera_ids(views: Iterable[CameraView]) -> dict[str, int]:
    """Return the ids of cameras by their line of ``cameras.txt``; those with the same line are the same camera."""
    lines = dict.fromkeys(_camera_line(camera) for view in views for camera in view.cameras.values())
    return {line: number for number, line in enumerate(lines, start=1)}


def _camera_line(camera: Camera) -> str:
    """Return a camera's model, size and parameters in COLMAP's format, without the id."""
    K = camera.K
    parameters = [K[0, 0], K[1, 1], K[0, 2] + HALF_PIXEL, K[1, 2] + HALF_PIXEL]
    model = "PINHOLE"
    if np.any(camera.distortion):
        model = "FULL_OPENCV"
        parameters += [*camera.distortion, 0.0, 0.0, 0.0]
    return f"{model} {camera.width} {camera.height} {_format_floats(parameters)}"


def _format_floats(values: Iterable[float]) -> str:
    """Return the values separated by spaces, with enough digits to restore the same float64."""
    return " ".join(repr(float(value)) for value in values)


def _with_header(columns: str, lines: Iterable[str]) -> str:
    """Return the lines as a file's text, after a comment that names the columns."""
    return "".join(f"{line}\n" for line in (f"# {columns}", *lines))


def json_lines(head: Mapping[str, Any], name: str, entries: Sequence[Mapping[str, Any]]) -> str:
    """Return ``head`` as a JSON object with an additional member ``name``: the list of ``entries``, one per line.

    The result is readable: a short head, then a long list.
    """
    head_text = json.dumps({**head, name: []}, indent=1, allow_nan=False).removesuffix("[]\n}")
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
    distortion = dict(zip(LENS_TERMS, camera.distortion.tolist(), strict=True))
    return {**focal, **centre, "w": camera.width, "h": camera.height, **distortion}


# cameras.json for programs, and README.txt for people.

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
Files, NNNN being the view's number in its full trajectory, left and right the eye:
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


def ultralytics_yaml(folder: DatasetFolder, config: DatasetConfig, parts: Mapping[str, DatasetConfig]) -> str:
    """Return the data file of a config for Ultralytics; ``parts`` has its scenes by folder, relative to it.

    ``train`` and ``val`` are required keys, whose lists may be empty. Without splits, ``val`` has the test views.
    """
    images: dict[str, list[str]] = {split: [] for split in SPLITS}
    for name, part in parts.items():
        images[part.scene.split].append(f"{name}/images")
    val = images["validation"] if config.has_splits else list(images["test"])  # A list used twice gets an anchor.
    keys = {"train": images["train"], "val": val, "test": images["test"], "names": {0: "depth"}}
    return (
        f"# rebar-depth-bench, config {config.name}, dataset {folder.digest}, version {folder.version}\n"
        f"# depth/*.npy: planar, float32 metres, 0 where there is no surface. Licence: {LICENCE}\n"
        f"{yaml.safe_dump(keys, sort_keys=False)}"
    )
