"""Static files: style sheets and scripts of this package and of the report, served without a build step.

URLs contain a digest of the content, so that browsers can cache a file permanently and fetch a new version when
it changes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files

from fastapi import APIRouter, HTTPException, Request, Response

router = APIRouter(include_in_schema=False)

_STYLE, _SCRIPT = "text/css; charset=utf-8", "text/javascript; charset=utf-8"
_SOURCES = {
    "report.css": ("rebar_depth_bench.reporting.html", "report.css", _STYLE),
    "sortable.js": ("rebar_depth_bench.reporting.html", "sortable.js", _SCRIPT),
    "page.css": ("leaderboard.web.pages", "static/page.css", _STYLE),
    "page.js": ("leaderboard.web.pages", "static/page.js", _SCRIPT),
}
_MAX_AGE_S, _IMMUTABLE_MAX_AGE_S = 300, 31536000
"""Cache lifetimes without and with the current digest in the URL."""


@dataclass(frozen=True)
class StaticFile:
    """Content, media type and digest (first 16 hexadecimal digits of its SHA-256) of a static file."""

    content: bytes
    media_type: str
    digest: str


_ICON = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 32 32">'
    '<rect width="32" height="32" rx="6" fill="#14171b"/>'
    '<path d="M9 5v22M16 5v22M23 5v22" stroke="#74a9ff" stroke-width="3"/>'
    '<path d="M5 11h22M5 21h22" stroke="#fb923c" stroke-width="3"/></svg>'
)


def _read(package: str, name: str, media_type: str) -> StaticFile:
    return _file(files(package).joinpath(name).read_bytes(), media_type)


def _file(content: bytes, media_type: str) -> StaticFile:
    return StaticFile(content, media_type, hashlib.sha256(content).hexdigest()[:16])


STATIC: Mapping[str, StaticFile] = {
    **{name: _read(*source) for name, source in _SOURCES.items()},
    "icon.svg": _file(_ICON.encode(), "image/svg+xml"),
}


def static_path(name: str) -> str:
    """Return the URL path of a file below the root path, with its digest."""
    return f"/static/{name}?v={STATIC[name].digest}"


@router.get("/static/{name}", name="static")
def static(name: str, request: Request, v: str = "") -> Response:
    """Return a file, or 304 if the client's copy is current."""
    if name not in STATIC:
        raise HTTPException(404, "no such file")
    file = STATIC[name]
    cache_control = (
        f"public, max-age={_IMMUTABLE_MAX_AGE_S}, immutable"
        if v == file.digest
        else f"public, max-age={_MAX_AGE_S}"
    )
    headers = {"ETag": f'"{file.digest}"', "Cache-Control": cache_control}
    if file.digest in request.headers.get("if-none-match", ""):
        return Response(status_code=304, headers=headers)
    return Response(file.content, media_type=file.media_type, headers=headers)
