"""HTML reports and pages of tables: contexts, templates, scripts and style sheets."""
