"""Service settings, read from the environment (``REBAR_LEADERBOARD_...``), a TOML file and the command line."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any, Literal
from urllib.parse import urlsplit

from pydantic import BaseModel, ByteSize, ConfigDict, Field, ValidationError, field_validator
from pydantic_core import ErrorDetails
from sqlalchemy import make_url
from sqlalchemy.exc import ArgumentError

from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.base.limits import TOML_BYTES
from rebar_depth_bench.base.reading import parse_toml, read_file
from rebar_depth_bench.base.validation import format_location, short_repr
from rebar_depth_bench.submission.declaration import is_http_url

ENVIRONMENT_PREFIX = "REBAR_LEADERBOARD_"
GIB = 1 << 30
MAX_LEASE_S = 600.0
"""Largest setting ``lease_seconds``; a lease that ends much later was made by a clock that was wrong."""


class Settings(BaseModel):
    """All settings with their defaults. Sizes are in bytes (``8GiB`` is accepted too), times in seconds."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    data: str = Field(description="dataset folder or Hub repository id")
    state_dir: Path = Field(
        Path("leaderboard-state"), description="folder for the database, archives and temporary files"
    )
    db: str = Field("", description="database URL; default: SQLite in the state folder")
    archives: str = Field("", description="folder for archives; default: in the state folder")
    host: str = Field("127.0.0.1", description="address to listen on")
    port: int = Field(8000, ge=0, le=65535, description="port to listen on; 0 selects a free port")
    public_url: str = Field(
        "",
        description="address of the leaderboard behind a proxy, for links; requests for other hosts are refused",
    )
    title: str = Field("Rebar depth leaderboard", description="title shown on the pages")
    contact: str = Field("", description="how to reach the operator for a token, shown on the pages")
    dataset_url: str = Field("", description="address from which submitters get the dataset, for links")
    paper_url: str = Field("", description="address of the paper, for links and the citation")
    default_visibility: Literal["owner", "always"] = Field(
        "always",
        description="always: every scored submission is public; owner: only after its owner publishes it",
    )
    quota: int = Field(10, ge=0, description="accepted submissions per token and day (UTC)")
    quota_bytes: ByteSize = Field(
        ByteSize(64 * GIB), ge=0, description="bytes of accepted archives per token and day (UTC)"
    )
    max_upload: ByteSize = Field(ByteSize(16 * GIB), gt=0, description="maximum size of an archive")
    rescore: bool = Field(False, description="score submissions of another dataset again, against this one")
    workers: int = Field(1, ge=0, le=64, description="number of submissions that `serve` scores at a time")
    score_time: float = Field(3600.0, gt=0, description="time limit for checking or scoring an archive")
    score_memory: ByteSize = Field(
        ByteSize(4 * GIB), gt=0, description="memory limit for checking or scoring an archive"
    )
    lease_seconds: float = Field(
        20.0,
        gt=0,
        le=MAX_LEASE_S,
        description="time without a heartbeat from a worker after which its job is reassigned, at most 600",
    )

    @field_validator("db")
    @classmethod
    def _check_database_url(cls, url: str) -> str:
        expected = "expected sqlite:///PATH or postgresql://USER:PASSWORD@HOST:PORT/NAME"
        if url and not re.match(r"sqlite:///[^?]|postgresql(\+psycopg)?://", url):
            raise ValueError(expected)
        try:
            make_url(url or "sqlite:///x")
        except (ArgumentError, ValueError):
            raise ValueError(expected) from None
        return url

    @field_validator("archives")
    @classmethod
    def _check_archive_folder(cls, archives: str) -> str:
        if "://" in archives:
            raise ValueError("expected a folder; remote storage can be mounted as one")
        return archives

    @field_validator("dataset_url", "paper_url")
    @classmethod
    def _check_link(cls, url: str) -> str:
        if url and not is_http_url(url):
            raise ValueError("expected an address such as https://example.org/dataset")
        return url

    @field_validator("public_url")
    @classmethod
    def _check_public_url(cls, url: str) -> str:
        if url and not (is_http_url(url) and not urlsplit(url).query and not urlsplit(url).fragment):
            raise ValueError("expected an address such as https://leaderboard.example.org")
        return url.rstrip("/")

    @property
    def database_url(self) -> str:
        """Database URL in the form that SQLAlchemy expects."""
        if not self.db:
            return f"sqlite:///{self.state_dir.absolute() / 'leaderboard.sqlite'}"
        return self.db.replace("postgresql://", "postgresql+psycopg://", 1)

    @property
    def archive_dir(self) -> Path:
        """Folder of the archives."""
        return Path(self.archives or self.state_dir / "archives").absolute()

    @property
    def spool(self) -> Path:
        """Folder for uploads that are not accepted yet."""
        return self.state_dir.absolute() / "spool"


TOKEN_VARIABLE = f"{ENVIRONMENT_PREFIX}TOKEN"
"""Variable of the client, which a submitter may have set."""
_SETTING_NAMES = "REBAR_LEADERBOARD_NAME with one of the names " + ", ".join(Settings.model_fields)


def read_settings(file: Path | None, overrides: dict[str, Any]) -> Settings:
    """Return the settings; ``overrides`` (command line) precede ``file``, which precedes the environment.

    Raises ``InputError``, naming every invalid setting, and if ``file`` cannot be read as TOML. A variable of the
    environment that is no setting is refused too, because ignoring it could publish what it was to hide.
    """
    values: dict[str, Any] = {}
    for variable, value in os.environ.items():
        if variable.startswith(ENVIRONMENT_PREFIX) and variable != TOKEN_VARIABLE:
            name = variable.removeprefix(ENVIRONMENT_PREFIX).lower()
            if name not in Settings.model_fields:
                raise InputError(f"{variable}: there is no such setting, expected {_SETTING_NAMES}")
            values[name] = value
    if file is not None:
        content, problems = parse_toml(read_file(file, TOML_BYTES, "a TOML file with settings", InputError))
        if problems:
            raise InputError.from_problems(file, problems)
        values |= content
    try:
        return Settings.model_validate(values | overrides)
    except ValidationError as error:
        raise InputError("settings: " + "; ".join(_format_error(details) for details in error.errors())) from None


_SECRET_SETTINGS = ("db",)
"""Settings whose value may contain a password."""


def _format_error(error: ErrorDetails) -> str:
    """Return the message for an invalid setting; its value is included unless it may contain a secret."""
    name = format_location("", ".".join(map(str, error["loc"])))
    if error["type"] == "missing":
        return f"{name}: is not given, expected {Settings.model_fields[name].description}"
    if error["type"] == "extra_forbidden":
        return f"{name}: there is no such setting"
    message = error["msg"].removeprefix("Value error, ")
    return f"{name}: {message}" + (
        "" if error["loc"][0] in _SECRET_SETTINGS else f", got {short_repr(error['input'])}"
    )
