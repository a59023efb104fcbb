"""Content of a scene file without rendering: bars, sizes, contacts and clashes, placement, and a picture."""
