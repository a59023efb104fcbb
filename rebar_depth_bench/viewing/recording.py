"""Recordings of rerun: the entities of one view and the layout of the viewer. Only this module imports rerun.

All entities are static and below ``world``, in the world frame of the dataset, metres:
``truth/<part>``, ``predictions/<name>/native|scaled/<part>``, ``bars``, ``left`` (camera with ``rgb`` and
``depth``) and ``right`` (with ``rgb``). Parts are those of ``clouds``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import UInt8
from numpy import ndarray

from rebar_depth_bench.data.bars import Bar, with_axis
from rebar_depth_bench.geometry.cameras import Camera, inverse_rigid
from rebar_depth_bench.viewing.clouds import (
    BACKGROUND,
    SURROUNDINGS,
    Clouds,
    PointCloud,
    PredictionClouds,
    truth_clouds,
)
from rebar_depth_bench.viewing.view import ShownView

APPLICATION = "rebar-depth-bench"
_PIXEL_CENTRE = 0.5
"""Offset of pixel centres: in rerun the centre of the first pixel is (0.5, 0.5)."""
_FRUSTUM_RATIO = 0.15
"""Distance of a camera's picture from its centre, as a share of the median depth."""
_BAR_COLOUR = (120, 130, 145)


def record_view(view: ShownView, predictions: Sequence[PredictionClouds]) -> bytes:
    """Return the content of an ``.rrd`` file that shows a view; its bytes differ from run to run.

    Predictions have different names.
    """
    stream = rr.RecordingStream(APPLICATION)
    memory = stream.memory_recording()
    stream.send_recording_name(view.view_id)
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    _log_clouds(stream, ["world", "truth"], truth_clouds(view))
    for prediction in predictions:
        path = ["world", "predictions", prediction.name]
        _log_clouds(stream, [*path, "native"], prediction.native)
        if prediction.scaled is not None:
            _log_clouds(stream, [*path, "scaled"], prediction.scaled)
    _log_bars(stream, with_axis(view.bars))
    depth_m = view.left.depth_m
    frustum_m = _FRUSTUM_RATIO * float(np.median(depth_m[depth_m > 0])) if (depth_m > 0).any() else 1.0
    _log_camera(stream, "left", view.left.camera, view.left.rgb, frustum_m)
    if view.right_camera is not None:
        _log_camera(stream, "right", view.right_camera, view.right_rgb, frustum_m)
    stream.log("world/left/depth", rr.DepthImage(depth_m, meter=1.0), static=True)
    stream.send_blueprint(_layout(view, predictions))
    content: bytes = memory.drain_as_bytes()
    return content


def _layout(view: ShownView, predictions: Sequence[PredictionClouds]) -> rrb.Blueprint:
    """Return the layout: 3D beside the left image and depth.

    Scaled predictions, the surroundings of predictions and the background, which would make the steel tiny, are
    hidden.
    """
    hidden = rrb.EntityBehavior(visible=False)
    overrides: dict[Any, Any] = {
        "world/left/depth": hidden
    }  # In 3D it would be a second cloud, without the lens's distortion.
    overrides[f"world/truth/{BACKGROUND}"] = hidden
    for prediction in predictions:
        path = ["world", "predictions", prediction.name]
        for part in (SURROUNDINGS, BACKGROUND):
            overrides[rr.new_entity_path([*path, "native", part])] = hidden
        overrides[rr.new_entity_path([*path, "scaled"])] = hidden
    space = rrb.Spatial3DView(origin="world", name=view.view_id, overrides=overrides)
    kinds = ("rgb", "depth") if view.left.rgb is not None else ("depth",)
    images = [rrb.Spatial2DView(origin="world/left", contents=[f"world/left/{kind}"], name=kind) for kind in kinds]
    return rrb.Blueprint(rrb.Horizontal(space, rrb.Vertical(*images), column_shares=[2, 1]), collapse_panels=True)


def _log_clouds(stream: rr.RecordingStream, path: list[object], clouds: Clouds) -> None:
    for part, cloud in clouds.items():
        stream.log([*path, part], _points(cloud), static=True)


def _points(cloud: PointCloud) -> rr.Points3D:
    return rr.Points3D(cloud.points_m, radii=cloud.radii_m, colors=cloud.colours)


def _log_bars(stream: rr.RecordingStream, bars: Sequence[Bar]) -> None:
    """Log the axes as strips with the bars' radii, labelled with id, role and diameter."""
    strips = rr.LineStrips3D(
        [np.array(bar.axis_m) for bar in bars],
        radii=[bar.diameter_m / 2 for bar in bars],
        colors=[_BAR_COLOUR] * len(bars),
        labels=[f"{bar.bar_id}: {bar.role}, {1000 * bar.diameter_m:g} mm" for bar in bars],
        show_labels=False,
    )
    stream.log("world/bars", strips, static=True)


def _log_camera(
    stream: rr.RecordingStream, eye: str, camera: Camera, rgb: UInt8[ndarray, "h w 3"] | None, frustum_m: float
) -> None:
    world_from_cam = inverse_rigid(camera.cam_from_world)
    K = camera.K.copy()
    K[:2, 2] += _PIXEL_CENTRE
    stream.log(
        f"world/{eye}",
        rr.Transform3D(translation=world_from_cam[:3, 3], mat3x3=world_from_cam[:3, :3]),
        rr.Pinhole(
            image_from_camera=K,
            resolution=(camera.width, camera.height),
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=frustum_m,
        ),
        static=True,
    )
    if rgb is not None:
        stream.log(f"world/{eye}/rgb", rr.Image(rgb), static=True)
