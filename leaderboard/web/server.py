"""Web server of ``rebar-leaderboard serve``, with its local scoring workers."""

from __future__ import annotations

import signal
import socket
import sys
import threading
from ipaddress import ip_address

import structlog
import uvicorn

from leaderboard.db.engine import without_password
from leaderboard.scoring.worker import running_workers
from leaderboard.service import open_service
from leaderboard.settings import Settings
from leaderboard.web.app import make_app
from rebar_depth_bench import software_version
from rebar_depth_bench.base.errors import InputError

SHUTDOWN_GRACE_S = 10
MAX_CONNECTIONS = 500
"""Number of connections from which on requests are answered 503, so that file descriptors do not run out."""
_SWITCH_INTERVAL_S = 0.0005
"""Interval of switches between threads; with Python's 5 ms, a response waits for several of them."""
_LOG = structlog.get_logger("server")


def serve(settings: Settings) -> None:
    """Serve until SIGTERM or SIGINT; then finish open requests and requeue running jobs.

    Open requests have ``SHUTDOWN_GRACE_S`` seconds. Raises ``InputError`` if the service cannot be started.
    """
    with open_service(settings) as service, listening_socket(settings) as listener:
        config = uvicorn.Config(
            make_app(service),
            access_log=False,
            log_config=None,  # Its messages go through the logging set up by ``set_up_logs``.
            log_level="warning",
            timeout_graceful_shutdown=SHUTDOWN_GRACE_S,
            server_header=False,
            # Only a proxy, which a public URL tells of, may state the address of the client.
            proxy_headers=bool(settings.public_url),
            http="h11",
            ws="none",  # A handshake would be answered by the application, which has no WebSocket.
            limit_concurrency=MAX_CONNECTIONS,
        )
        host, port = listener.getsockname()[:2]
        url_host = f"[{host}]" if ":" in host else host
        print(f"http://{url_host}:{port}", file=sys.stderr, flush=True)
        if not (settings.public_url or ip_address(host.partition("%")[0]).is_loopback):
            risk = "tokens are sent without TLS, and every Host header is accepted"
            _LOG.warning(f"{risk}: set public_url, and run a proxy with TLS before the service", host=host)
        server = uvicorn.Server(config)
        # While pages are rendered in threads, the event loop gets the interpreter back after this time.
        sys.setswitchinterval(_SWITCH_INTERVAL_S)

        stop_workers = threading.Event()

        def stop(*_: object) -> None:
            server.should_exit = True
            stop_workers.set()

        # uvicorn re-raises caught signals when it ends; the default handler would exit before the workers stop.
        for signal_number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(signal_number, stop)
        details = {"version": software_version(), "dataset": service.folder.digest, "scorers": settings.workers}
        _LOG.info("serving", database=without_password(settings.database_url), **details)
        with running_workers(service.database, settings, stop_workers) as workers:
            service.workers.extend(workers)
            server.run(sockets=[listener])
        _LOG.info("stopped")


def listening_socket(settings: Settings) -> socket.socket:
    """Return a socket that listens on the address of the settings, without Nagle's algorithm.

    Raises ``InputError`` if the address is in use or not available here.
    """
    try:
        family = socket.getaddrinfo(settings.host, settings.port)[0][0]
        listener = socket.create_server((settings.host, settings.port), family=family, backlog=512)
    except (OSError, UnicodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{settings.host}:{settings.port}: cannot listen on this address: {reason}") from None
    # Connections inherit this. asyncio sets it only for sockets whose protocol is IPPROTO_TCP, which that of
    # ``create_server`` is not; with Nagle's algorithm every small response on a kept connection waits 40 ms.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return listener
