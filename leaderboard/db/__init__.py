"""Database: models, engine, migrations, and queries of submissions, jobs and rankings."""
