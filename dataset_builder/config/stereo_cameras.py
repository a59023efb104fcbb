"""Stereo cameras that can be bought, with baseline and field of view, for the views of generated cages.

The fields of view are those of the pair of cameras that depth is computed from, at 16:9, as their makers state
them. The images are those of ideal pinholes: the differences that matter here are focal length and baseline.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import radians, tan

from dataset_builder.config.specs import FocalRigSpec
from rebar_depth_bench.geometry.cameras import NOMINAL_FOCAL_PX, NOMINAL_WIDTH


@dataclass(frozen=True)
class StereoCamera:
    """Stereo camera: name, distance of the eyes in metres, and focal length in pixels of an image 1280 px wide."""

    name: str
    baseline_m: float
    focal_px: float

    def rig(self) -> FocalRigSpec:
        """Return the rig of two parallel pinholes with this baseline and focal length."""
        return FocalRigSpec(baseline_m=self.baseline_m, camera=self.name, focal_px=self.focal_px)


def focal_of_view_px(horizontal_deg: float) -> float:
    """Return the focal length that shows ``horizontal_deg`` in an image 1280 px wide, to 0.1 px."""
    return round(NOMINAL_WIDTH / 2 / tan(radians(horizontal_deg) / 2), 1)


_ALL = (
    StereoCamera("Stereolabs ZED", 0.120, NOMINAL_FOCAL_PX),  # HD720; the rig of the paper.
    StereoCamera("Luxonis OAK-D", 0.075, 882.5),  # Documentation of stereo depth, 1280 x 800 pixels.
    StereoCamera("Intel RealSense D415", 0.055, focal_of_view_px(65.0)),
    StereoCamera("Intel RealSense D435", 0.050, focal_of_view_px(87.0)),
    StereoCamera("Intel RealSense D455", 0.095, focal_of_view_px(87.0)),
)
STEREO_CAMERAS: Mapping[str, StereoCamera] = {camera.name: camera for camera in _ALL}
"""Cameras by name."""
