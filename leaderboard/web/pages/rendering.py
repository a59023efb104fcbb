"""Template rendering, formatting of values for the pages, and error responses as JSON or HTML."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any
from urllib.parse import urlsplit

from fastapi import Request, Response
from fastapi.responses import HTMLResponse, JSONResponse
from jinja2 import Environment, PackageLoader
from markupsafe import Markup

from leaderboard.names import confused_scripts
from leaderboard.service import Service
from leaderboard.web.middleware import NO_STORE, REVALIDATE
from leaderboard.web.pages.board_columns import seconds_text
from rebar_depth_bench import software_version
from rebar_depth_bench.base.errors import MAX_PROBLEMS_SHOWN, Problem, printable
from rebar_depth_bench.reporting.html.assets import environment
from rebar_depth_bench.reporting.published import load_published
from rebar_depth_bench.scoring import formatting
from rebar_depth_bench.scoring.columns import number
from rebar_depth_bench.scoring.protocol import PROTOCOL
from rebar_depth_bench.submission.declaration import INPUTS, is_http_url

MAX_TEXT_CHARS = 4000
_STEPS = ((1 << 30, "GiB"), (1 << 20, "MiB"), (1 << 10, "KiB"))
_TITLES = {404: "Page not found", 405: "Method not allowed", 422: "Invalid request"}


def make_templates() -> Environment:
    """Return the Jinja environment of the pages, which also contains the templates of the report."""
    templates = environment(PackageLoader("leaderboard.web.pages", "templates"))
    templates.filters.update(
        clean=clean_text,
        link=link_html,
        number=number,
        ground_truth=formatting.ground_truth_text,
        inputs=formatting.inputs_text,
        notes=formatting.table_notes,
        scripts=confused_scripts,
        seconds=seconds_text,
        size=format_size,
        time=time_html,
    )
    templates.globals.update(
        protocol=PROTOCOL,
        input_classes=INPUTS,
        counted=formatting.counted,
        paper_title=load_published().title,
    )
    return templates


def render(
    request: Request,
    template: str,
    *,
    status_code: int = 200,
    cache: str = REVALIDATE,
    headers: Mapping[str, str] | None = None,
    **context: Any,
) -> HTMLResponse:
    """Return the page rendered from a template with ``context`` and the context common to all pages.

    The common context does not depend on the request, except for the path below which the service is.
    """
    service: Service = request.app.state.service
    templates: Environment = request.app.state.templates
    settings = service.settings
    common = {
        "root": str(request.scope.get("root_path", "").rstrip("/")),
        "site": printable(settings.title),
        "settings": settings,
        "stamps": {
            "Protocol": PROTOCOL,
            "Dataset version": printable(service.folder.version),
            "Dataset digest": printable(service.folder.digest),
            "Software": f"rebar-depth-bench {software_version()}",
        },
        "contact": printable(settings.contact),
        "service": service,
    }
    content = templates.get_template(template).render({**common, **context})
    return HTMLResponse(content, status_code, {"Cache-Control": cache, **(headers or {})})


def time_html(seconds: float, date_only: bool = False) -> Markup:
    """Return a Unix timestamp in seconds as a ``time`` element in UTC."""
    when = datetime.fromtimestamp(seconds, UTC)
    text = when.strftime("%Y-%m-%d" if date_only else "%Y-%m-%d %H:%M UTC")
    return Markup('<time datetime="{}">{}</time>').format(when.strftime("%Y-%m-%dT%H:%M:%SZ"), text)


def link_html(url: str | None, text: str = "") -> Markup:
    """Return a link to a submitter's URL; nothing if it is no valid http or https URL.

    The link shows its host, or ``text`` with the host as title.
    """
    if not url or not is_http_url(url):
        return Markup()
    host = printable(urlsplit(url).hostname or "", 60)
    link = Markup('<a href="{}" title="{}" rel="nofollow noopener noreferrer">{}</a>')
    return link.format(url, host, text or host)


def clean_text(text: str | None) -> str:
    """Return untrusted text without control characters, cut to ``MAX_TEXT_CHARS`` characters; lines are kept."""
    truncated = (text or "")[: MAX_TEXT_CHARS + 1]
    clean = "\n".join(printable(line, MAX_TEXT_CHARS + 1) for line in truncated.splitlines())
    return clean if len(clean) <= MAX_TEXT_CHARS else clean[: MAX_TEXT_CHARS - 1] + "…"


def format_size(count: int) -> str:
    """Return a number of bytes as text in bytes, KiB, MiB or GiB."""
    for step, unit in _STEPS:
        if count >= step:
            return f"{count / step:.1f}".removesuffix(".0") + f" {unit}"
    return f"{count} bytes"


def problem_lines(problems: Sequence[Problem]) -> list[str]:
    """Return the first ``MAX_PROBLEMS_SHOWN`` problems as text, followed by the number of the others if any."""
    omitted = len(problems) - MAX_PROBLEMS_SHOWN
    return [*map(str, problems[:MAX_PROBLEMS_SHOWN]), *([f"... and {omitted} more"] if omitted > 0 else [])]


def error_response(
    request: Request,
    status: int,
    detail: str,
    headers: Mapping[str, str] | None = None,
    problems: Sequence[Problem] = (),
) -> Response:
    """Return an error response: a page if a browser requests a path outside the API, otherwise JSON."""
    lines = problem_lines(problems)
    if request.url.path.startswith("/api/") or "text/html" not in request.headers.get("accept", ""):
        content: dict[str, Any] = {"detail": detail}
        if problems:
            details = [asdict(problem) for problem in problems[:MAX_PROBLEMS_SHOWN]]
            content |= {"problems": lines, "problem_details": details}
        return JSONResponse(content, status, headers)
    message = "" if detail in ("Not Found", "Method Not Allowed") else clean_text("\n".join(lines) or detail)
    return render(
        request,
        "refusal.html.j2",
        status_code=status,
        cache=NO_STORE,
        headers=headers,
        title=_TITLES.get(status, "Request failed"),
        detail=message,
    )
