"""Bearer tokens: creation, replacement and lookup. Only their hashes are stored."""

from __future__ import annotations

import hashlib
import secrets
import time
from collections.abc import Mapping
from typing import Any

from sqlalchemy import and_, func, select, update
from sqlalchemy.exc import IntegrityError

from leaderboard.db.engine import Database
from leaderboard.db.models import SubmissionModel, TokenModel
from leaderboard.db.submissions import DELETED
from leaderboard.names import name_problem, normalised
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.base.validation import short_repr

PREFIX = "rdb_"
MAX_NAME = 100


def create_token(database: Database, name: str, *, baseline: bool = False) -> str:
    """Create and return a token for ``name``; ``baseline`` marks its submissions as the organiser's.

    Raises ``InputError`` if the name is taken, blank, longer than ``MAX_NAME`` characters or not printable.
    """
    name = _checked_name(name)
    token = PREFIX + secrets.token_urlsafe(32)
    try:
        with database.write() as session:
            row = TokenModel(name=name, sha256=digest(token), created_at=time.time(), baseline=baseline)
            session.add(row)
    except IntegrityError:
        raise InputError(f"a token for {name!r} already exists, expected another name or --replace") from None
    return token


def _checked_name(name: str) -> str:
    """Return a name normalised. Raises ``InputError`` if no token can have it."""
    name = normalised(name)
    has_length = 0 < len(name) <= MAX_NAME
    if problem := name_problem(name) if has_length else f"expected 1 to {MAX_NAME} printable characters":
        raise InputError(f"the token name is {short_repr(name)}, {problem}")
    return name


def replace_token(database: Database, name: str) -> str:
    """Create and return a token for ``name`` that replaces the old one. Raises ``InputError`` if there is none."""
    token = PREFIX + secrets.token_urlsafe(32)
    _change(database, name, {"sha256": digest(token), "revoked_at": None})
    return token


def revoke_token(database: Database, name: str) -> None:
    """Revoke the token of ``name``, whose submissions stay. Raises ``InputError`` if there is none."""
    _change(database, name, {"revoked_at": time.time()})


def _change(database: Database, name: str, values: Mapping[str, Any]) -> None:
    name = _checked_name(name)
    with database.write() as session:
        changed = session.scalar(
            update(TokenModel).where(TokenModel.name == name).values(**values).returning(TokenModel.id)
        )
    if changed is None:
        raise InputError(f"there is no token for {name!r}, expected the name of an existing token")


def list_tokens(database: Database) -> list[tuple[str, float, float | None, int, int]]:
    """Return name, times of creation and revocation, number of submissions and their bytes of all tokens.

    The oldest token comes first. Submissions that were deleted are not counted.
    """
    query = (
        select(
            TokenModel.name,
            TokenModel.created_at,
            TokenModel.revoked_at,
            func.count(SubmissionModel.id).label("submissions"),
            func.coalesce(func.sum(SubmissionModel.archive_bytes), 0).label("size"),
        )
        .outerjoin(
            SubmissionModel, and_(SubmissionModel.token_id == TokenModel.id, SubmissionModel.status != DELETED)
        )
        .group_by(TokenModel.id)
        .order_by(TokenModel.created_at)
    )
    with database.read() as session:
        return [(*row,) for row in session.execute(query)]


def find_token(database: Database, token: str) -> TokenModel | None:
    """Return the row of a token, or None if the token is unknown or revoked."""
    query = select(TokenModel).where(TokenModel.sha256 == digest(token), TokenModel.revoked_at.is_(None))
    with database.read() as session:
        return session.scalar(query)


def digest(token: str) -> str:
    """Return the SHA-256 of a token in hexadecimal. No salt or slow hash is needed for 256 random bits."""
    return hashlib.sha256(token.encode()).hexdigest()
