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
from leaderboard.web.cache import NO_STORE, REVALIDATE
from rebar_depth_bench import software_version
from rebar_depth_bench.base.errors import MAX_PROBLEMS_SHOWN, Problem, printable
from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.reporting.html.assets import environment
from rebar_depth_bench.reporting.published import load_published
from rebar_depth_bench.scoring.columns import number
from rebar_depth_bench.scoring.protocol import PROTOCOL
from rebar_depth_bench.scoring.result import COVERAGE_RULE
from rebar_depth_bench.submission.declaration import INPUTS, is_http_url


def make_templates() -> Environment:
    """Return the Jinja environment of the pages, which also contains the templates of the report."""
    templates = environment(PackageLoader("leaderboard.web.pages", "templates"))
    templates.filters.update(
        clean=clean_text,
        link=link_html,
        number=number,
        notes=formatting.table_notes,
        scripts=confused_scripts,
        size=format_size,
        time=time_html,
    )
    templates.globals.update(
        protocol=PROTOCOL,
        input_classes=INPUTS,
        plural=formatting.plural,
        is_degenerate=lambda interval: len(set(interval.split(" – "))) == 1,
        picture_titles=PICTURE_TITLES,
        max_intervals=MAX_INTERVALS_PLOTTED,
        paper_title=load_published().title,
        coverage_rule=COVERAGE_RULE,
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
    """Return the page rendered from a template with ``context`` and the context common to all pages."""
    service: Service = request.app.state.service
    templates: Environment = request.app.state.templates
    content = templates.get_template(template).render({**_common_context(request, service), **context})
    return HTMLResponse(content, status_code, {"Cache-Control": cache, **(headers or {})})


def _common_context(request: Request, service: Service) -> dict[str, Any]:
    """Return the context of all pages; of the request, it depends on the path below which the service is only."""
    root = str(request.scope.get("root_path", "").rstrip("/"))
    settings = service.settings
    return {
        "root": root,
        "site": printable(settings.title),
        "settings": settings,
        "stamps": [
            ("Protocol", PROTOCOL),
            ("Dataset version", printable(service.folder.version)),
            ("Dataset digest", printable(service.folder.digest)),
            ("Software", f"rebar-depth-bench {software_version()}"),
        ],
        "hidden_truth": settings.hidden_truth,
        "contact": printable(settings.contact),
        "service": service,
        "view_counts": service.view_counts,
    }


MAX_INTERVALS_PLOTTED = 60
"""Number of points up to which a plot has their intervals."""
PICTURE_TITLES = {"colour": "Colour", "truth": "Ground truth", "prediction": "Prediction", "error": "Native error"}
"""Headings of the pictures of a view by kind, in the order in which they are shown."""
MAX_TEXT_CHARS = 4000
_STEPS = ((1 << 30, "GiB"), (1 << 20, "MiB"), (1 << 10, "KiB"))


def time_html(seconds: float, date_only: bool = False) -> Markup:
    """Return a Unix timestamp in seconds as a ``time`` element in UTC."""
    when = datetime.fromtimestamp(seconds, UTC)
    text = when.strftime("%Y-%m-%d" if date_only else "%Y-%m-%d %H:%M UTC")
    return Markup('<time datetime="{}">{}</time>').format(when.strftime("%Y-%m-%dT%H:%M:%SZ"), text)


def link_html(url: str | None) -> Markup:
    """Return a link that shows the host of a submitter's URL; nothing if it is no valid http or https URL."""
    if not url or not is_http_url(url):
        return Markup()
    link = Markup('<a href="{}" rel="nofollow noopener noreferrer">{}</a>')
    return link.format(url, printable(urlsplit(url).hostname or "", 60))


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


def problem_lines(problems: Sequence[Problem], limit: int | None = MAX_PROBLEMS_SHOWN) -> list[str]:
    """Return the first ``limit`` problems (None: all) as text, followed by the number of the others if any."""
    shown = problems[:limit]
    omitted = len(problems) - len(shown)
    return [*map(str, shown), *([f"... and {omitted} more"] if omitted else [])]


_TITLES = {404: "Page not found", 405: "Method not allowed", 422: "Invalid request"}


def error_response(
    request: Request,
    status: int,
    detail: str,
    headers: Mapping[str, str] | None = None,
    problems: Sequence[Problem] = (),
    limit: int | None = MAX_PROBLEMS_SHOWN,
) -> Response:
    """Return an error response: a page if a browser requests a path outside the API, otherwise JSON.

    At most ``limit`` problems are shown.
    """
    content: dict[str, Any] = {"detail": detail}
    if problems:
        content["problems"] = problem_lines(problems, limit)
        content["problem_details"] = [asdict(problem) for problem in problems[:limit]]
    if not request.url.path.startswith("/api/") and "text/html" in request.headers.get("accept", ""):
        return _error_page(request, status, "\n".join(content.get("problems", [detail])), headers)
    return JSONResponse(content, status, headers)


def _error_page(request: Request, status: int, detail: str, headers: Mapping[str, str] | None) -> Response:
    title = _TITLES.get(status, "Request failed")
    message = "" if detail in ("Not Found", "Method Not Allowed") else clean_text(detail)
    context = {"title": title, "detail": message}
    return render(request, "refusal.html.j2", status_code=status, cache=NO_STORE, headers=headers, **context)
