"""Inline SVG charts of reports and pages of tables."""
