"""HTTP service: application, middleware, response cache, API and pages."""
