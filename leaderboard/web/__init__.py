"""Web application: middleware, API and pages."""
