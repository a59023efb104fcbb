"""What an operator may set: by environment (``REBAR_LEADERBOARD_...``), a TOML file, or the command line."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError
from pydantic_settings import BaseSettings, SettingsConfigDict

from rebar_depth_bench.errors import InputError

GIB = 1 << 30


class Settings(BaseSettings):
    """Every setting, with its default. Sizes are bytes, times seconds."""

    model_config = SettingsConfigDict(env_prefix="REBAR_LEADERBOARD_", extra="forbid", frozen=True)

    data: str = Field(description="the dataset: a folder, or a Hub repository id")
    state: Path = Field(Path("leaderboard-state"), description="folder for all that the service keeps")
    db: str = Field("", description="database URL; default: SQLite in the state folder")
    archives: str = Field("", description="where archives are kept, any fsspec URL; default: the state folder")
    host: str = Field("127.0.0.1", description="address to listen on")
    port: int = Field(8000, ge=0, le=65535, description="port to listen on; 0 takes a free one")
    title: str = Field("Rebar depth leaderboard", description="the page's title")
    public: Literal["owner", "always"] = Field(
        "always", description="whether every submission is on the board at once, or once its owner says so"
    )
    quota: int = Field(10, ge=0, description="accepted submissions a token may make in a day (UTC)")
    max_upload: int = Field(8 * GIB, gt=0, description="largest archive")
    error_maps: int = Field(
        0,
        ge=0,
        le=100,
        description="worst views of a config shown as error maps, which tell the truth to whoever predicted",
    )
    scorers: int = Field(1, ge=0, le=64, description="scoring processes that `serve` starts itself")
    cluster: str = Field("", description="address of a dask scheduler whose workers score")
    score_time: float = Field(3600.0, gt=0, description="longest that scoring an archive may take")
    score_memory: int = Field(4 * GIB, gt=0, description="most memory that scoring an archive may take")
    lease: float = Field(20.0, gt=0, description="a scorer that is silent for so long has lost its job")
    reads: str = Field("600/minute", description="requests an address may make")
    writes: str = Field("60/minute", description="uploads and changes an address may make")

    @property
    def database_url(self) -> str:
        """The database's URL as SQLAlchemy takes it."""
        if not self.db:
            return f"sqlite:///{self.state.absolute() / 'leaderboard.sqlite'}"
        return self.db.replace("postgresql://", "postgresql+psycopg://", 1)

    @property
    def archives_url(self) -> str:
        """The URL of the folder of archives."""
        return self.archives or (self.state.absolute() / "archives").as_uri()

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
        lines = [f"{'.'.join(map(str, one['loc']))}: {one['msg']}, got {one['input']!r}" for one in error.errors()]
        raise InputError("settings: " + "; ".join(lines)) from None
