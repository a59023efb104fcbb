"""Content of a scene file without rendering: bars, sizes, overlaps, placement, and a picture."""
