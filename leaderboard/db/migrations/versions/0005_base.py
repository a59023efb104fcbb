"""Schema of the first release; a new database gets the current schema at once."""

revision, down_revision = "0005", None


def upgrade() -> None:
    """Do nothing: no database is upgraded to this revision."""
