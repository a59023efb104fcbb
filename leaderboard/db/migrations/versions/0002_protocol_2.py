"""Rank error, declarations of submissions, and the protocol of results.

Rows that exist are those of protocol rebar-1: they have no rank error and are not ranked.
"""

import sqlalchemy as sa
from alembic import op

revision, down_revision = "0002", "0001"


def upgrade() -> None:
    """Add the columns, and remove the ranks of the rows that exist."""
    op.add_column("submissions", sa.Column("inputs", sa.String(length=20), nullable=True))
    op.add_column("submissions", sa.Column("uses_ground_truth", sa.Boolean(), nullable=True))
    op.add_column("results", sa.Column("protocol", sa.String(length=20), nullable=False, server_default="rebar-1"))
    op.add_column("board_rows", sa.Column("rank_error", sa.Float(), nullable=True))
    op.drop_column("board_rows", "abs_rel")
    op.execute(sa.table("board_rows", sa.column("ranked", sa.Boolean())).update().values(ranked=False))
