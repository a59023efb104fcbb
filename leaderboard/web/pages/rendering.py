"""A template and what it shows as a response.

Texts from archives and numbers of the service, as the pages spell them.

Refusals: JSON, or a page for those who asked for a page.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any
from urllib.parse import urlsplit

from fastapi import Request, Response
from fastapi.responses import HTMLResponse, JSONResponse
from jinja2 import Environment, PackageLoader

from leaderboard.web.cache import FRESH, PRIVATE
from leaderboard.web.context import Service
from leaderboard.web.pages.static import address
from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.reporting.formatting import printable
from rebar_depth_bench.reporting.html.assets import environment
from rebar_depth_bench.scoring.protocol import MIN_RANKED_COVERAGE, PROTOCOL, WITHIN_MM
from rebar_depth_bench.submission.metadata import url_problems
from rebar_depth_bench.version import software_version


def make_templates() -> Environment:
    """Return the templates of the pages; parts of them are the report's."""
    return environment(PackageLoader("leaderboard.web.pages", "templates"))


def render(
    request: Request,
    template: str,
    *,
    status_code: int = 200,
    cache: str = FRESH,
    headers: Mapping[str, str] | None = None,
    **shown: Any,
) -> HTMLResponse:
    """Return the page that a template makes of what is ``shown`` and of what every page shows."""
    content = page_content(request, template, **shown)
    return HTMLResponse(content, status_code, {"Cache-Control": cache, **(headers or {})})


def page_content(request: Request, template: str, **shown: Any) -> bytes:
    """Return the bytes of what ``render`` responds with, to be kept as long as ``place`` is the same."""
    service: Service = request.app.state.service
    templates: Environment = request.app.state.templates
    return templates.get_template(template).render({**_common(request, service), **shown}).encode()


def place(request: Request) -> str:
    """Return all that pages take from the request itself, not from its address: where the service's root is."""
    return str(request.scope.get("root_path", "").rstrip("/"))


def service_address(request: Request) -> str:
    """Return the service's address as the browser has it, without a slash at its end."""
    return str(request.base_url).rstrip("/")


def _common(request: Request, service: Service) -> dict[str, Any]:
    root = place(request)
    return {
        "root": root,
        "static": lambda name: root + address(name),
        "site": formatting.printable(service.settings.title),
        "protocol": PROTOCOL,
        "stamps": [
            ("Protocol", PROTOCOL),
            ("Dataset version", formatting.printable(service.folder.version)),
            ("Dataset digest", formatting.printable(service.folder.digest)),
            ("Software", f"rebar-depth-bench {software_version()}"),
        ],
        "metric_heads": formatting.METRIC_HEADS,
        "tolerances": WITHIN_MM,
        "dash_note": formatting.DASH_NOTE,
        "interval_note": formatting.INTERVAL_NOTE,
        "min_coverage": f"{MIN_RANKED_COVERAGE * 100:.0f}",
        "plural": formatting.plural,
    }


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


_TITLES = {404: "There is no such page", 405: "That cannot be done here", 422: "The address is malformed"}


def refusal(
    request: Request,
    status: int,
    detail: str,
    headers: Mapping[str, str] | None = None,
    problems: Sequence[str] | None = None,
) -> Response:
    """Return the answer that refuses a request: a page where a browser asks, and not the API; JSON else."""
    if not request.url.path.startswith("/api/") and "text/html" in request.headers.get("accept", ""):
        return _page(request, status, "\n".join(problems or (detail,)), headers)
    content = {"detail": detail} if problems is None else {"detail": detail, "problems": list(problems)}
    return JSONResponse(content, status, headers)


def _page(request: Request, status: int, detail: str, headers: Mapping[str, str] | None) -> Response:
    title = _TITLES.get(status, "That did not work")
    said = "" if detail in ("Not Found", "Method Not Allowed") else lines(detail)
    shown = {"title": title, "detail": said}
    return render(request, "refusal.html.j2", status_code=status, cache=PRIVATE, headers=headers, **shown)
