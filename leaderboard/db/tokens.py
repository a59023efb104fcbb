"""Tokens: made once, shown once, kept as a hash."""

from __future__ import annotations

import hashlib
import secrets
import time

from sqlalchemy import select
from sqlalchemy.exc import IntegrityError

from leaderboard.db.engine import Database
from leaderboard.db.models import TokenRecord
from rebar_depth_bench.errors import InputError

PREFIX = "rdb_"
MAX_NAME = 100


def create_token(database: Database, name: str) -> str:
    """Return a new token for ``name``. Raises ``InputError`` for a name that is taken, empty or too long."""
    if not name.strip() or len(name) > MAX_NAME or not name.isprintable():
        raise InputError(f"a token's name is {name!r}, expected 1 to {MAX_NAME} printable characters")
    token = PREFIX + secrets.token_urlsafe(32)
    try:
        with database.write() as session:
            session.add(TokenRecord(name=name, sha256=digest(token), created_at=time.time()))
    except IntegrityError:
        raise InputError(f"there is a token for {name!r} already, expected another name, or --replace") from None
    return token


def replace_token(database: Database, name: str) -> str:
    """Return a new token for ``name``; the old one is void. Raises ``InputError`` where there is none."""
    token = PREFIX + secrets.token_urlsafe(32)
    with database.write() as session:
        record = session.scalar(select(TokenRecord).where(TokenRecord.name == name))
        if record is None:
            raise InputError(f"there is no token for {name!r}, expected the name of one")
        record.sha256 = digest(token)
    return token


def find_token(database: Database, token: str) -> TokenRecord | None:
    """Return a token's record, None for an unknown one."""
    with database.read() as session:
        return session.scalar(select(TokenRecord).where(TokenRecord.sha256 == digest(token)))


def digest(token: str) -> str:
    """Return what is kept of a token. A plain hash is enough: there is nothing to guess in 256 random bits."""
    return hashlib.sha256(token.encode()).hexdigest()
