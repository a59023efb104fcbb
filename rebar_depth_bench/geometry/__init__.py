"""Camera geometry: projection, lenses, rectification, ArUco boards."""
