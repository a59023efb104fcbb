"""Initial schema, which earlier versions created; a new database gets the current schema at once."""

revision, down_revision = "0001", None


def upgrade() -> None:
    """Do nothing: no database is upgraded to this revision."""
