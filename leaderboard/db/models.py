"""SQLAlchemy models of the database tables. Times are Unix timestamps in seconds."""

from __future__ import annotations

from sqlalchemy import BigInteger, Boolean, Float, ForeignKey, Index, Integer, LargeBinary, String, Text
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

from rebar_depth_bench.scoring.protocol import OLD_PROTOCOL


class Base(DeclarativeBase):
    """Declarative base class of the models."""


class TokenModel(Base):
    """A submitter and the SHA-256 of their token, which has 256 random bits; the token is not stored."""

    __tablename__ = "tokens"

    id: Mapped[int] = mapped_column(Integer, primary_key=True)
    name: Mapped[str] = mapped_column(String(100), unique=True)
    sha256: Mapped[str] = mapped_column(String(64), unique=True)
    created_at: Mapped[float] = mapped_column(Float)


class SubmissionModel(Base):
    """An accepted archive and its status. Deleted submissions keep their rows, which count for the quota."""

    __tablename__ = "submissions"
    __table_args__ = (
        Index("ix_submissions_status_created_at", "status", "created_at"),
        Index("ix_submissions_token_id_created_at", "token_id", "created_at"),
    )

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    token_id: Mapped[int] = mapped_column(ForeignKey("tokens.id"))
    method: Mapped[str] = mapped_column(String(200))
    description: Mapped[str | None] = mapped_column(Text)
    url: Mapped[str | None] = mapped_column(Text)
    uses_intrinsics: Mapped[bool | None] = mapped_column(Boolean)
    inputs: Mapped[str | None] = mapped_column(String(20))
    uses_ground_truth: Mapped[bool | None] = mapped_column(Boolean)
    archive_sha256: Mapped[str] = mapped_column(String(64))
    archive_bytes: Mapped[int] = mapped_column(BigInteger)
    status: Mapped[str] = mapped_column(String(10))
    reason: Mapped[str | None] = mapped_column(Text)
    public: Mapped[bool] = mapped_column(Boolean)
    created_at: Mapped[float] = mapped_column(Float)
    finished_at: Mapped[float | None] = mapped_column(Float)
    attempts: Mapped[int] = mapped_column(Integer)
    scorer: Mapped[str | None] = mapped_column(String(64))
    lease_until: Mapped[float | None] = mapped_column(Float)
    dataset_digest: Mapped[str] = mapped_column(String(100))


class ResultModel(Base):
    """The result JSON of a scored submission, byte-identical to that of the command line, and its protocol."""

    __tablename__ = "results"

    submission_id: Mapped[str] = mapped_column(ForeignKey("submissions.id"), primary_key=True)
    json: Mapped[bytes] = mapped_column(LargeBinary)
    protocol: Mapped[str] = mapped_column(String(20), server_default=OLD_PROTOCOL)


class LeaderboardRowModel(Base):
    """A submission's leaderboard row of one config: the table's JSON and the columns for filtering and sorting."""

    __tablename__ = "board_rows"

    submission_id: Mapped[str] = mapped_column(ForeignKey("submissions.id"), primary_key=True)
    config: Mapped[str] = mapped_column(String(100), primary_key=True)
    ranked: Mapped[bool] = mapped_column(Boolean)
    rank_error: Mapped[float | None] = mapped_column(Float)
    json: Mapped[str] = mapped_column(Text)


class ErrorMapModel(Base):
    """An error map of one view as a WebP image."""

    __tablename__ = "pictures"

    submission_id: Mapped[str] = mapped_column(ForeignKey("submissions.id"), primary_key=True)
    view_id: Mapped[str] = mapped_column(String(201), primary_key=True)
    webp: Mapped[bytes] = mapped_column(LargeBinary)
