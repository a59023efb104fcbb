"""Detectors of crossings, a task beside depth: files of detections, matching, average precision and results."""
