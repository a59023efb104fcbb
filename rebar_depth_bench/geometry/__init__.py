"""Camera geometry: projection, calibration, rectification, ArUco boards."""
