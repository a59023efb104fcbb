"""Reports of results: HTML pages, terminal tables, CSV, LaTeX and SVG charts."""
