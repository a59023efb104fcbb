"""A template and what it shows as a response."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fastapi import Request
from fastapi.responses import HTMLResponse
from jinja2 import Environment, PackageLoader

from leaderboard.kept import FRESH
from leaderboard.page.static_files import address
from leaderboard.service import Service
from rebar_depth_bench import wording
from rebar_depth_bench.protocol import MIN_RANKED_COVERAGE, PROTOCOL, WITHIN_MM
from rebar_depth_bench.report.templates import environment
from rebar_depth_bench.version import software_version


def make_templates() -> Environment:
    """Return the templates of the pages; parts of them are the report's."""
    return environment(PackageLoader("leaderboard.page", "templates"))


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
        "site": wording.printable(service.settings.title),
        "protocol": PROTOCOL,
        "stamps": [
            ("Protocol", PROTOCOL),
            ("Dataset version", wording.printable(service.folder.version)),
            ("Dataset digest", wording.printable(service.folder.digest)),
            ("Software", f"rebar-depth-bench {software_version()}"),
        ],
        "metric_heads": wording.METRIC_HEADS,
        "tolerances": WITHIN_MM,
        "dash_note": wording.DASH_NOTE,
        "interval_note": wording.INTERVAL_NOTE,
        "min_coverage": f"{MIN_RANKED_COVERAGE * 100:.0f}",
        "plural": wording.plural,
    }
