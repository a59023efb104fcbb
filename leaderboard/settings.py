"""What an operator may set: by environment (``REBAR_LEADERBOARD_...``), a TOML file, or the command line."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any, Literal

from limits import parse_many
from pydantic import ByteSize, Field, ValidationError, field_validator
from pydantic_core import ErrorDetails
from pydantic_settings import BaseSettings, SettingsConfigDict
from sqlalchemy import make_url
from sqlalchemy.exc import ArgumentError

from rebar_depth_bench.errors import InputError

GIB = 1 << 30


class Settings(BaseSettings):
    """Every setting, with its default. Sizes are bytes (8GiB does too), times seconds."""

    model_config = SettingsConfigDict(env_prefix="REBAR_LEADERBOARD_", extra="forbid", frozen=True)

    data: str = Field(description="the dataset: a folder, or a Hub repository id")
    state: Path = Field(Path("leaderboard-state"), description="folder for all that the service keeps")
    db: str = Field("", description="database URL; default: SQLite in the state folder")
    archives: str = Field("", description="where archives are kept, any fsspec URL; default: the state folder")
    host: str = Field("127.0.0.1", description="address to listen on")
    port: int = Field(8000, ge=0, le=65535, description="port to listen on; 0 takes a free one")
    title: str = Field("Rebar depth leaderboard", description="the page's title")
    public: Literal["owner", "always"] = Field(
        "always", description="always: every submission is on the board at once; owner: once its owner says so"
    )
    quota: int = Field(10, ge=0, description="accepted submissions a token may make in a day (UTC)")
    max_upload: ByteSize = Field(ByteSize(8 * GIB), gt=0, description="largest archive")
    error_maps: int = Field(
        0,
        ge=0,
        le=100,
        description="worst views of a config shown as error maps, which tell the truth to whoever predicted",
    )
    rescore: bool = Field(False, description="score again, against this dataset, what was submitted for another")
    scorers: int = Field(1, ge=0, le=64, description="scoring processes that `serve` starts itself")
    cluster: str = Field("", description="address of a dask scheduler whose workers score")
    score_time: float = Field(3600.0, gt=0, description="longest that scoring an archive may take")
    score_memory: ByteSize = Field(
        ByteSize(4 * GIB), gt=0, description="most memory that scoring an archive may take"
    )
    lease: float = Field(20.0, gt=0, description="a scorer that is silent for so long has lost its job")
    reads: str = Field("600/minute", description="requests an address may make")
    writes: str = Field("60/minute", description="uploads and changes an address may make")

    @field_validator("db")
    @classmethod
    def _is_database(cls, url: str) -> str:
        wanted = "expected sqlite:///PATH or postgresql://USER:PASSWORD@HOST:PORT/NAME"
        if url and not re.match(r"sqlite:///[^?]|postgresql(\+psycopg)?://", url):
            raise ValueError(wanted)
        try:
            make_url(url or "sqlite:///x")
        except (ArgumentError, ValueError):
            raise ValueError(wanted) from None
        return url

    @field_validator("reads", "writes")
    @classmethod
    def _is_rate(cls, rate: str) -> str:
        try:
            (parsed,) = parse_many(rate)
            if parsed.amount < 1 or parsed.multiples < 1:
                raise ValueError
        except ValueError:
            raise ValueError("expected a rate such as 600/minute or 10/second") from None
        return rate

    @property
    def database_url(self) -> str:
        """The database's URL as SQLAlchemy takes it."""
        if not self.db:
            return f"sqlite:///{self.state.absolute() / 'leaderboard.sqlite'}"
        return self.db.replace("postgresql://", "postgresql+psycopg://", 1)

    @property
    def archives_url(self) -> str:
        """The URL of the folder of archives, as ``fsspec`` takes it: without escapes."""
        return self.archives or f"file://{self.state.absolute() / 'archives'}"

    @property
    def spool(self) -> Path:
        """The folder of what is under way: uploads that are not accepted yet, archives fetched to be scored."""
        return self.state.absolute() / "spool"


def read_settings(file: Path | None, given: dict[str, Any]) -> Settings:
    """Return the settings: what was ``given`` on the command line, else the file's, else the environment's.

    Raises ``InputError`` that names each setting at fault.
    """
    try:
        stored = {} if file is None else tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{file}: cannot be read as TOML: {error}") from None
    try:
        return Settings(**{**stored, **given})
    except ValidationError as error:
        raise InputError("settings: " + "; ".join(_in_words(one) for one in error.errors())) from None


_UNSHOWN = ("db", "archives")
"""Settings that may hold a password."""


def _in_words(error: ErrorDetails) -> str:
    """Say what is wrong with a setting, and what it is, unless that may be a secret."""
    name = ".".join(map(str, error["loc"]))
    if error["type"] == "missing":
        return f"{name}: is not given, expected {Settings.model_fields[name].description}"
    if error["type"] == "extra_forbidden":
        return f"{name}: there is no such setting"
    message = error["msg"].removeprefix("Value error, ")
    return f"{name}: {message}" + ("" if error["loc"][0] in _UNSHOWN else f", got {error['input']!r}")
