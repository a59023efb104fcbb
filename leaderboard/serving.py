"""``rebar-leaderboard serve``: the web server, and the scorers beside it."""

from __future__ import annotations

import signal
import socket
import sys

import uvicorn

from leaderboard.app import make_app
from leaderboard.crew import Crew
from leaderboard.service import open_service
from leaderboard.settings import Settings
from rebar_depth_bench.errors import InputError

GRACE_S = 10


def serve(settings: Settings) -> None:
    """Serve until SIGTERM or SIGINT: answers under way are finished, jobs at hand are queued again."""
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
        with Crew(settings, settings.scorers):
            server.run(sockets=[listening])


def _listen(settings: Settings) -> socket.socket:
    """Return a listening socket. Raises ``InputError`` where the address is taken or not this machine's."""
    try:
        family = socket.getaddrinfo(settings.host, settings.port)[0][0]
        return socket.create_server((settings.host, settings.port), family=family, backlog=512)
    except (OSError, UnicodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{settings.host}:{settings.port}: cannot listen there: {reason}") from None
