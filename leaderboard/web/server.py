"""``rebar-leaderboard serve``: the web server, and the scorers beside it."""

from __future__ import annotations

import signal
import socket
import sys

import structlog
import uvicorn

from leaderboard.redact import without_password
from leaderboard.scoring.dask_backend import check_dask
from leaderboard.scoring.supervisor import Crew
from leaderboard.settings import Settings
from leaderboard.web.app import make_app
from leaderboard.web.context import open_service
from rebar_depth_bench.errors import InputError
from rebar_depth_bench.version import software_version

GRACE_S = 10
_LOG = structlog.get_logger("server")


def serve(settings: Settings) -> None:
    """Serve until SIGTERM or SIGINT: answers under way are finished, jobs at hand are queued again."""
    if settings.cluster:
        check_dask()
    with open_service(settings) as service, _listen(settings) as listening:
        config = uvicorn.Config(
            make_app(service),
            access_log=False,
            log_config=None,  # its lines go the way of ours
            log_level="warning",
            timeout_graceful_shutdown=GRACE_S,
            server_header=False,
        )
        host, port = listening.getsockname()[:2]
        shown = f"[{host}]" if ":" in host else host
        print(f"http://{shown}:{port}", file=sys.stderr, flush=True)
        server = uvicorn.Server(config)

        def stop(*_: object) -> None:
            server.should_exit = True

        # uvicorn raises what it caught once more at its end: the default would end us before the scorers stop.
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, stop)
        told = {"version": software_version(), "dataset": service.folder.digest, "scorers": settings.scorers}
        _LOG.info("serving", database=without_password(settings.database_url), **told)
        with Crew(settings, settings.scorers):
            server.run(sockets=[listening])
        _LOG.info("stopped")


def _listen(settings: Settings) -> socket.socket:
    """Return a listening socket. Raises ``InputError`` where the address is taken or not this machine's."""
    try:
        family = socket.getaddrinfo(settings.host, settings.port)[0][0]
        return socket.create_server((settings.host, settings.port), family=family, backlog=512)
    except (OSError, UnicodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{settings.host}:{settings.port}: cannot listen there: {reason}") from None
