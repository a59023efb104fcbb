"""Measures at the crossings of bars: tie points, gaps, angles and normals of cylinders fitted to the depth."""
