"""How Alembic runs the migrations: on the connection that ``Database.migrate`` hands it."""

from alembic import context

from leaderboard.db.models import Base

context.configure(connection=context.config.attributes["connection"], target_metadata=Base.metadata)
context.run_migrations()
