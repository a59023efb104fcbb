"""SVG charts of reports."""
