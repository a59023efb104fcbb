"""Simulated laser scanners, registered with the benchmark as methods through the public entry points.

The paper leaves "a synthetic LiDAR baseline on the existing meshes" as future work. A custom scanner is a Python
file with ``METHOD = lidar_method("mine", ScannerSpec(...), "my scanner")``.
"""

from dataset_builder.lidar.method import LIDAR_MOBILE, LIDAR_SURVEY, lidar_method
from dataset_builder.lidar.scanner import MOBILE, SURVEY, ScannerSpec

__all__ = ["LIDAR_MOBILE", "LIDAR_SURVEY", "MOBILE", "SURVEY", "ScannerSpec", "lidar_method"]
