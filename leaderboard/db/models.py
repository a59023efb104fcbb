"""SQLAlchemy models of the database tables. Times are Unix timestamps in seconds."""

from __future__ import annotations

from typing import ClassVar

from sqlalchemy import (
    BigInteger,
    Connection,
    Float,
    ForeignKey,
    Index,
    LargeBinary,
    String,
    Table,
    Text,
    event,
    update,
)
from sqlalchemy.orm import DeclarativeBase, Mapped, Session, mapped_column


class Base(DeclarativeBase):
    """Declarative base class of the models."""

    type_annotation_map: ClassVar = {float: Float()}  # Not Double, which differs from the tables that exist.


class TokenModel(Base):
    """A submitter and the SHA-256 of their token, which has 256 random bits; the token is not stored."""

    __tablename__ = "tokens"

    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(100), unique=True)
    sha256: Mapped[str] = mapped_column(String(64), unique=True)
    created_at: Mapped[float]
    revoked_at: Mapped[float | None]


class SubmissionModel(Base):
    """An accepted archive and its status. Deleted submissions keep their rows, which count for the quota.

    ``details`` is a JSON object with what the submitter says of the method (``MethodDetails``), and the declared
    seconds per view, without what is not given; ``archive_deleted_at`` is set when the
    archive of a submission that stays was deleted.
    """

    __tablename__ = "submissions"
    __table_args__ = (
        Index("ix_submissions_status_created_at", "status", "created_at"),
        Index("ix_submissions_token_id_created_at", "token_id", "created_at"),
        Index("ix_submissions_token_id_archive_sha256", "token_id", "archive_sha256"),
    )

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    token_id: Mapped[int] = mapped_column(ForeignKey("tokens.id"))
    method: Mapped[str] = mapped_column(String(200))
    inputs: Mapped[str | None] = mapped_column(String(20))
    uses_ground_truth: Mapped[bool | None]
    archive_sha256: Mapped[str] = mapped_column(String(64))
    archive_bytes: Mapped[int] = mapped_column(BigInteger)
    status: Mapped[str] = mapped_column(String(10))
    reason: Mapped[str | None] = mapped_column(Text)
    public: Mapped[bool]
    created_at: Mapped[float]
    finished_at: Mapped[float | None]
    attempts: Mapped[int]
    scorer: Mapped[str | None] = mapped_column(String(64))
    lease_until: Mapped[float | None]
    dataset_digest: Mapped[str] = mapped_column(String(100))
    details: Mapped[str] = mapped_column(Text, server_default="{}")
    archive_deleted_at: Mapped[float | None]


class ResultModel(Base):
    """The result JSON of a scored submission, byte-identical to that of the command line.

    ``notes`` is a JSON array of sentences on possible mistakes in the submission.
    """

    __tablename__ = "results"

    submission_id: Mapped[str] = mapped_column(ForeignKey("submissions.id"), primary_key=True)
    json: Mapped[bytes] = mapped_column(LargeBinary)
    notes: Mapped[str] = mapped_column(Text, server_default="[]")


class LeaderboardRowModel(Base):
    """A submission's leaderboard row of one config: the table's JSON and the columns for filtering and sorting.

    ``view_errors`` are the rank errors of the views, as ``view_errors.view_errors`` returns them. The row is
    derived from the result.
    """

    __tablename__ = "board_rows"

    submission_id: Mapped[str] = mapped_column(ForeignKey("submissions.id"), primary_key=True)
    config: Mapped[str] = mapped_column(String(100), primary_key=True)
    ranked: Mapped[bool]
    rank_error: Mapped[float | None]
    json: Mapped[str] = mapped_column(Text)
    view_errors: Mapped[str | None] = mapped_column(Text)


class PictureModel(Base):
    """A view with pictures: their size in pixels and the texts of their colour bars, as a JSON object."""

    __tablename__ = "picture_views"

    submission_id: Mapped[str] = mapped_column(ForeignKey("submissions.id"), primary_key=True)
    view_id: Mapped[str] = mapped_column(String(201), primary_key=True)
    facts: Mapped[str] = mapped_column(Text)


class PictureImageModel(Base):
    """A picture of a view as a WebP image."""

    __tablename__ = "picture_images"

    submission_id: Mapped[str] = mapped_column(ForeignKey("submissions.id"), primary_key=True)
    view_id: Mapped[str] = mapped_column(String(201), primary_key=True)
    kind: Mapped[str] = mapped_column(String(20), primary_key=True)
    webp: Mapped[bytes] = mapped_column(LargeBinary)


class ContentVersionModel(Base):
    """Counter in a single row that every change of a published page's content increments."""

    __tablename__ = "content_version"

    id: Mapped[int] = mapped_column(primary_key=True)
    value: Mapped[int] = mapped_column(BigInteger)


@event.listens_for(Base.metadata.tables["content_version"], "after_create")
def _insert_version(table: Table, connection: Connection, **_: object) -> None:
    connection.execute(table.insert().values(id=1, value=1))


def increment_content_version(session: Session) -> None:
    """Increment the version in the transaction of a change, so that both become visible together."""
    session.execute(update(ContentVersionModel).values(value=ContentVersionModel.value + 1))
