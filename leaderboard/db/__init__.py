"""Database layer: models, engine, and queries for submissions, jobs and rankings."""
