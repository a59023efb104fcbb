"""Simulated laser scanners, offered to the bench as methods through the entry points that anyone's methods use.

The paper leaves "a synthetic LiDAR baseline on the existing meshes" as future work. A user's own scanner is
``METHOD = lidar_method("mine", ScannerSpec(...), "my scanner")`` in a Python file.
"""

from dataset_builder.lidar.method import LIDAR_MOBILE, LIDAR_SURVEY, lidar_method
from dataset_builder.lidar.scanner import MOBILE, SURVEY, ScannerSpec

__all__ = ["LIDAR_MOBILE", "LIDAR_SURVEY", "MOBILE", "SURVEY", "ScannerSpec", "lidar_method"]
