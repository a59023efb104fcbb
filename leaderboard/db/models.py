"""The database's tables. Times are seconds since 1970, UTC."""

from __future__ import annotations

from sqlalchemy import BigInteger, Boolean, Float, ForeignKey, Index, Integer, LargeBinary, String, Text
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column


class Base(DeclarativeBase):
    """The tables' common root."""


class TokenRecord(Base):
    """Who may submit. The token itself is not kept, its SHA-256 is: it holds 256 random bits."""

    __tablename__ = "tokens"

    id: Mapped[int] = mapped_column(Integer, primary_key=True)
    name: Mapped[str] = mapped_column(String(100), unique=True)
    sha256: Mapped[str] = mapped_column(String(64), unique=True)
    created_at: Mapped[float] = mapped_column(Float)


class SubmissionRecord(Base):
    """An accepted archive and what became of it. A deleted one keeps its row, so that the quota keeps count."""

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


class ResultRecord(Base):
    """A scored submission's JSON, byte for byte what the command line writes."""

    __tablename__ = "results"

    submission_id: Mapped[str] = mapped_column(ForeignKey("submissions.id"), primary_key=True)
    json: Mapped[bytes] = mapped_column(LargeBinary)


class RowRecord(Base):
    """A config's row on the board: the table's JSON, and what rows are chosen and sorted by."""

    __tablename__ = "board_rows"

    submission_id: Mapped[str] = mapped_column(ForeignKey("submissions.id"), primary_key=True)
    config: Mapped[str] = mapped_column(String(100), primary_key=True)
    ranked: Mapped[bool] = mapped_column(Boolean)
    abs_rel: Mapped[float | None] = mapped_column(Float)
    json: Mapped[str] = mapped_column(Text)


class PictureRecord(Base):
    """An error map of a view, WebP."""

    __tablename__ = "pictures"

    submission_id: Mapped[str] = mapped_column(ForeignKey("submissions.id"), primary_key=True)
    view_id: Mapped[str] = mapped_column(String(201), primary_key=True)
    webp: Mapped[bytes] = mapped_column(LargeBinary)
