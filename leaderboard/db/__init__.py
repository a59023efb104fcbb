"""Database layer: models, engine, migrations, and queries for submissions, jobs and rankings."""
