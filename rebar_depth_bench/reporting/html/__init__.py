"""HTML reports: pages, their sections, templates and scripts."""
