"""Content version, details of methods, pictures of four kinds, notes, view errors, and revoked tokens.

The stored error maps become pictures of the kind ``error``, whose size and colour range are unknown.
"""

import json

import sqlalchemy as sa
from alembic import op

revision, down_revision = "0003", "0002"


def upgrade() -> None:
    """Add the columns and tables, and convert the error maps."""
    op.add_column("tokens", sa.Column("revoked_at", sa.Float(), nullable=True))
    op.add_column("submissions", sa.Column("details", sa.Text(), nullable=False, server_default="{}"))
    op.add_column("submissions", sa.Column("archive_deleted_at", sa.Float(), nullable=True))
    op.create_index("ix_submissions_token_id_archive_sha256", "submissions", ["token_id", "archive_sha256"])
    op.add_column("results", sa.Column("notes", sa.Text(), nullable=False, server_default="[]"))
    op.add_column("board_rows", sa.Column("view_errors", sa.LargeBinary(), nullable=True))
    _create_content_version()
    _create_pictures()
    _fill_view_errors()


def _create_content_version() -> None:
    table = op.create_table(
        "content_version",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("value", sa.BigInteger(), nullable=False),
        sa.PrimaryKeyConstraint("id"),
    )
    op.bulk_insert(table, [{"id": 1, "value": 1}])


def _create_pictures() -> None:
    views = op.create_table(
        "picture_views",
        sa.Column("submission_id", sa.String(length=32), nullable=False),
        sa.Column("view_id", sa.String(length=201), nullable=False),
        sa.Column("facts", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(["submission_id"], ["submissions.id"]),
        sa.PrimaryKeyConstraint("submission_id", "view_id"),
    )
    images = op.create_table(
        "picture_images",
        sa.Column("submission_id", sa.String(length=32), nullable=False),
        sa.Column("view_id", sa.String(length=201), nullable=False),
        sa.Column("kind", sa.String(length=20), nullable=False),
        sa.Column("webp", sa.LargeBinary(), nullable=False),
        sa.ForeignKeyConstraint(["submission_id"], ["submissions.id"]),
        sa.PrimaryKeyConstraint("submission_id", "view_id", "kind"),
    )
    names = ("submission_id", "view_id", "webp")
    old = sa.table("pictures", *(sa.column(name) for name in names))
    id_and_view = (old.c.submission_id, old.c.view_id)
    op.execute(
        sa.insert(views).from_select(
            ["submission_id", "view_id", "facts"], sa.select(*id_and_view, sa.literal("{}"))
        )
    )
    op.execute(
        sa.insert(images).from_select(
            ["submission_id", "view_id", "kind", "webp"],
            sa.select(*id_and_view, sa.literal("error"), old.c.webp),
        )
    )
    op.drop_table("pictures")


def _fill_view_errors() -> None:
    from leaderboard.db.view_errors import view_errors

    connection = op.get_bind()
    results = sa.table("results", sa.column("submission_id"), sa.column("json"))
    rows = sa.table("board_rows", sa.column("submission_id"), sa.column("config"), sa.column("view_errors"))
    for submission_id in connection.scalars(sa.select(results.c.submission_id)).all():
        content = connection.scalar(sa.select(results.c.json).where(results.c.submission_id == submission_id))
        result = json.loads(content or b"{}")
        for config in result["tables"]:
            connection.execute(
                sa.update(rows)
                .where(rows.c.submission_id == submission_id, rows.c.config == config)
                .values(view_errors=view_errors(result, config))
            )
