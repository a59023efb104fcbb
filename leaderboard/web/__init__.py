"""Web application: middleware, response cache, API and pages."""
