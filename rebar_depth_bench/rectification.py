"""The rectified pair of a calibrated stereo camera, as OpenCV computes it. Scoring never comes here."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.calibration import (
    StereoCalibration,
    calibrated_baseline_m,
    lens_distortion,
    lens_K,
    right_from_left,
)


@dataclass(frozen=True, eq=False)
class Rectification:
    """Two parallel pinholes that stand where the eyes stand.

    ``K`` (pixels) is both eyes'; ``R_left`` and ``R_right`` turn an eye's own axes into the rectified ones,
    ``x_rectified = R x_eye``; the right eye then stands ``baseline_m`` along the rectified x axis.
    """

    K: Float64[ndarray, "3 3"]
    R_left: Float64[ndarray, "3 3"]
    R_right: Float64[ndarray, "3 3"]
    baseline_m: float


def rectify(calibration: StereoCalibration) -> Rectification:
    """Return the rectification on the calibration's own grid.

    ``cv2.stereoRectify`` with zero disparity at infinity and ``alpha=0``, which leaves no pixel outside the raw
    pictures: what Stereolabs' open capture code calls. (Bouguet's method: each eye turns by half.)
    """
    motion = right_from_left(calibration)
    return rectify_pair(
        (lens_K(calibration.left), lens_K(calibration.right)),
        (lens_distortion(calibration.left), lens_distortion(calibration.right)),
        motion,
        calibration.width,
        calibration.height,
        calibrated_baseline_m(calibration),
    )


def rectify_pair(
    K: tuple[Float64[ndarray, "3 3"], Float64[ndarray, "3 3"]],
    distortion: tuple[Float64[ndarray, 5], Float64[ndarray, 5]],
    right_from_left: Float64[ndarray, "4 4"],
    width: int,
    height: int,
    baseline_m: float,
) -> Rectification:
    """Return the rectification of two eyes (left, right) given as a dataset row gives them, metres and pixels."""
    R_left, R_right, P_left, *_ = cv2.stereoRectify(
        K[0],
        distortion[0],
        K[1],
        distortion[1],
        (width, height),
        np.ascontiguousarray(right_from_left[:3, :3]),
        np.ascontiguousarray(right_from_left[:3, 3]),
        flags=cv2.CALIB_ZERO_DISPARITY,
        alpha=0,
    )
    return Rectification(np.asarray(P_left[:, :3]), np.asarray(R_left), np.asarray(R_right), baseline_m)
