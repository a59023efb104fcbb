"""HTML report and page of detections: contexts, templates, scripts and style sheets."""
