"""Alembic environment: runs the migrations on the connection provided by ``Database.migrate``."""

from alembic import context

from leaderboard.db.models import Base

context.configure(connection=context.config.attributes["connection"], target_metadata=Base.metadata)
context.run_migrations()
