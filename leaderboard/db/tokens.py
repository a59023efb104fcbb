"""Bearer tokens: creation, replacement and lookup. Only their hashes are stored."""

from __future__ import annotations

import hashlib
import secrets
import time

from sqlalchemy import select
from sqlalchemy.exc import IntegrityError

from leaderboard.db.engine import Database
from leaderboard.db.models import TokenModel
from rebar_depth_bench.errors import InputError

PREFIX = "rdb_"
MAX_NAME = 100


def create_token(database: Database, name: str) -> str:
    """Create and return a token for ``name``.

    Raises ``InputError`` if the name is taken, blank, longer than ``MAX_NAME`` characters or not printable.
    """
    if not name.strip() or len(name) > MAX_NAME or not name.isprintable():
        raise InputError(f"the token name is {name!r}, expected 1 to {MAX_NAME} printable characters")
    token = PREFIX + secrets.token_urlsafe(32)
    try:
        with database.write() as session:
            session.add(TokenModel(name=name, sha256=digest(token), created_at=time.time()))
    except IntegrityError:
        raise InputError(f"a token for {name!r} already exists, expected another name or --replace") from None
    return token


def replace_token(database: Database, name: str) -> str:
    """Create and return a token for ``name`` that replaces the old one. Raises ``InputError`` if there is none."""
    token = PREFIX + secrets.token_urlsafe(32)
    with database.write() as session:
        record = session.scalar(select(TokenModel).where(TokenModel.name == name))
        if record is None:
            raise InputError(f"there is no token for {name!r}, expected the name of an existing token")
        record.sha256 = digest(token)
    return token


def find_token(database: Database, token: str) -> TokenModel | None:
    """Return the row of a token, or None if the token is unknown."""
    with database.read() as session:
        return session.scalar(select(TokenModel).where(TokenModel.sha256 == digest(token)))


def digest(token: str) -> str:
    """Return the SHA-256 of a token in hexadecimal. No salt or slow hash is needed for 256 random bits."""
    return hashlib.sha256(token.encode()).hexdigest()
