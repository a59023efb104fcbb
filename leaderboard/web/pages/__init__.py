"""HTML pages, rendered on the server and complete without JavaScript, which adds convenience only."""
