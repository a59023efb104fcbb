"""Bounds of the numbers of a camera calibration: image sizes, intrinsics, distortion, and the motion of a pair."""

from __future__ import annotations

from rebar_depth_bench.validation import Expected, number

SIDES_PX = range(16, 16385)
"""Accepted widths and heights of images, pixels."""
MIN_PRINCIPAL_POINT = -0.5
"""Smallest coordinate of a principal point, pixels: the left edge of the first pixel, whose centre is at 0."""
ROTATION_TOLERANCE = 1e-6
"""Largest deviation of ``R @ R.T`` from the identity for a 3 x 3 rotation."""


def quantity(low: float, high: float, unit: str) -> Expected:
    """Return the description of numbers from ``low`` to ``high``."""
    return number(low, high, f"a number from {low:g} to {high:g} {unit}")


def principal_point(side_px: int) -> Expected:
    """Return the description of a coordinate of the principal point in an image of ``side_px`` pixels."""
    return quantity(MIN_PRINCIPAL_POINT, side_px - 0.5, "pixels")


FOCAL_PX = quantity(1, 1e5, "pixels")
DISTORTION = number(-1000, 1000)
ANGLE_RAD = quantity(-0.5, 0.5, "radians")
BASELINE_MM = quantity(1, 10_000, "millimetres")
OFFSET_MM = quantity(-1000, 1000, "millimetres")
BASELINE_M = quantity(0.001, 10, "metres")
OFFSET_M = quantity(-10, 10, "metres")
