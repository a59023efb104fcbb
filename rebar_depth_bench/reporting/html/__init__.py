"""HTML reports and study pages: contexts, templates, scripts and style sheets."""
