"""Texts from archives and numbers of the service, as the pages spell them."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from urllib.parse import urlsplit

from rebar_depth_bench.submission.metadata import url_problems
from rebar_depth_bench.wording import printable

MOST_TEXT = 4000
_STEPS = ((1 << 30, "GiB"), (1 << 20, "MiB"), (1 << 10, "KiB"))


@dataclass(frozen=True)
class Moment:
    """A time as people and as machines read it."""

    text: str
    iso: str


@dataclass(frozen=True)
class Link:
    """A method's own address and the host that is shown for it."""

    address: str
    host: str


def moment(seconds: float) -> Moment:
    """Return a time, seconds since 1970, in UTC."""
    when = datetime.fromtimestamp(seconds, UTC)
    return Moment(when.strftime("%Y-%m-%d %H:%M UTC"), when.strftime("%Y-%m-%dT%H:%M:%SZ"))


def lines(text: str | None, limit: int = MOST_TEXT) -> str:
    """Return a longer text, its lines kept, cut to ``limit``, without control or direction-changing characters."""
    kept = (text or "")[: limit + 1]
    clean = "\n".join(printable(line, limit + 1) for line in kept.splitlines())
    return clean if len(clean) <= limit else clean[: limit - 1] + "…"


def link(url: str | None) -> Link | None:
    """Return a method's address if it is one of http or https, else None."""
    if not url or url_problems(url):
        return None
    return Link(url, printable(urlsplit(url).hostname or "", 60))


def size(count: int) -> str:
    """Return a number of bytes in a unit that suits it."""
    for step, unit in _STEPS:
        if count >= step:
            return f"{count / step:.1f}".removesuffix(".0") + f" {unit}"
    return f"{count} bytes"
