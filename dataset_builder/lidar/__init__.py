"""Simulated laser scanners above the left camera, registered with the benchmark as methods by entry points.

A custom scanner is a Python file with ``METHOD = lidar_method("mine", ScannerSpec(...), "my scanner")``.
"""

from dataset_builder.lidar.scan_method import LIDAR_MOBILE, LIDAR_SURVEY, lidar_method
from dataset_builder.lidar.scanner import MOBILE, SURVEY, ScannerSpec

__all__ = ["LIDAR_MOBILE", "LIDAR_SURVEY", "MOBILE", "SURVEY", "ScannerSpec", "lidar_method"]
