"""Inline SVG charts of reports and study pages."""
