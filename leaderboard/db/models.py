"""SQLAlchemy models of the database tables. Times are Unix timestamps in seconds."""

from __future__ import annotations

import secrets

from sqlalchemy import (
    BigInteger,
    Connection,
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

SCHEMA = 5
"""Number of the schema; a database with another one is refused."""


class Base(DeclarativeBase):
    """Declarative base class of the models."""


class BoardModel(Base):
    """The single row of facts on the whole leaderboard.

    ``schema`` is ``SCHEMA`` of the version that made the tables. ``board_id`` is random; the marker in the archive
    folder has the same. ``dataset_digest`` is the digest of the dataset that was served last, None before the
    first time. Every change of what pages show increments ``content_version``.
    """

    __tablename__ = "board"

    id: Mapped[int] = mapped_column(primary_key=True)
    schema: Mapped[int]
    board_id: Mapped[str] = mapped_column(String(32))
    dataset_digest: Mapped[str | None] = mapped_column(String(100))
    content_version: Mapped[int] = mapped_column(BigInteger)


@event.listens_for(Base.metadata.tables["board"], "after_create")
def _insert_board(table: Table, connection: Connection, **_: object) -> None:
    connection.execute(
        table.insert().values(id=1, schema=SCHEMA, board_id=secrets.token_hex(16), content_version=1)
    )


def increment_content_version(session: Session) -> None:
    """Increment the version in the transaction of a change, so that both become visible together."""
    session.execute(update(BoardModel).values(content_version=BoardModel.content_version + 1))


class TokenModel(Base):
    """A submitter and the SHA-256 of their token, which has 256 random bits; the token is not stored.

    ``baseline`` marks the submissions of the organiser.
    """

    __tablename__ = "tokens"

    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(String(100), unique=True)
    sha256: Mapped[str] = mapped_column(String(64), unique=True)
    created_at: Mapped[float]
    revoked_at: Mapped[float | None]
    baseline: Mapped[bool]


class SubmissionModel(Base):
    """An accepted archive and the status of its job.

    ``status`` is ``queued`` or ``scoring`` while a job is to be done, ``scored`` if the submission has a result of
    any dataset, ``failed`` with ``reason`` if it has none, or ``deleted``. Deleted submissions keep their rows,
    which count for the quota. ``details`` is a JSON object with what the submitter says of the method
    (``MethodDetails``) and the declared seconds per view, without what is not given. ``archive_deleted_at`` is
    set when the archive was deleted, alone or with the submission.
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
    details: Mapped[str] = mapped_column(Text)
    archive_sha256: Mapped[str] = mapped_column(String(64))
    archive_bytes: Mapped[int] = mapped_column(BigInteger)
    archive_deleted_at: Mapped[float | None]
    public: Mapped[bool]
    created_at: Mapped[float]
    queued_at: Mapped[float]
    status: Mapped[str] = mapped_column(String(10))
    reason: Mapped[str | None] = mapped_column(Text)
    finished_at: Mapped[float | None]
    attempts: Mapped[int]
    scorer: Mapped[str | None] = mapped_column(String(64))
    lease_until: Mapped[float | None]


class ResultModel(Base):
    """What scoring a submission against one dataset under one protocol has given: a result, or a reason.

    ``json`` is the result, byte-identical to that of the command line, and ``notes`` a JSON array of sentences on
    possible mistakes in the submission. Where scoring has failed, ``reason`` says why, and ``json`` is None or the
    earlier result of the same dataset.
    ``intervals`` is the method of confidence intervals, as JSON.
    """

    __tablename__ = "results"

    submission_id: Mapped[str] = mapped_column(ForeignKey("submissions.id"), primary_key=True)
    dataset_digest: Mapped[str] = mapped_column(String(100), primary_key=True)
    protocol: Mapped[str] = mapped_column(String(100), primary_key=True)
    intervals: Mapped[str] = mapped_column(Text)
    json: Mapped[bytes | None] = mapped_column(LargeBinary)
    notes: Mapped[str] = mapped_column(Text)
    reason: Mapped[str | None] = mapped_column(Text)
    finished_at: Mapped[float]


class LeaderboardRowModel(Base):
    """A row of one config: the table's JSON and the columns for filtering and sorting, derived from a result."""

    __tablename__ = "board_rows"

    submission_id: Mapped[str] = mapped_column(ForeignKey("submissions.id"), primary_key=True)
    dataset_digest: Mapped[str] = mapped_column(String(100), primary_key=True)
    protocol: Mapped[str] = mapped_column(String(100), primary_key=True)
    config: Mapped[str] = mapped_column(String(100), primary_key=True)
    ranked: Mapped[bool]
    rank_error: Mapped[float | None]
    json: Mapped[str] = mapped_column(Text)
