"""Web server of ``rebar-leaderboard serve``: limits on its connections, and its local scoring workers."""

from __future__ import annotations

import asyncio
import resource
import signal
import socket
import sys
from collections import Counter
from dataclasses import dataclass, field
from ipaddress import ip_address

import h11
import structlog
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from leaderboard.db.engine import without_password
from leaderboard.scoring.worker import running_workers
from leaderboard.service import open_service
from leaderboard.settings import Settings
from leaderboard.storage.retention import archive_retention
from leaderboard.web.app import make_app
from rebar_depth_bench import software_version
from rebar_depth_bench.base.errors import InputError

SHUTDOWN_GRACE_S = 10
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
            http=limited_protocol(new_connection_counts(settings), settings.head_seconds),
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

        def stop(*_: object) -> None:
            server.should_exit = True

        # uvicorn re-raises caught signals when it ends; the default handler would exit before the workers stop.
        for signal_number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(signal_number, stop)
        details = {"version": software_version(), "dataset": service.folder.digest, "scorers": settings.workers}
        details["hidden_truth"] = settings.hidden_truth
        _LOG.info("serving", database=without_password(settings.database_url), **details)
        stores = (service.database, service.archives, service.folder, settings)
        with archive_retention(*stores), running_workers(service.database, settings) as workers:
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


# Limits on connections: their number in total and per address, and the time for the head of a request.

_OTHER_FILES = 256
"""File descriptors beside those of connections: database, archives, uploads, pipes of processes."""


@dataclass
class ConnectionCounts:
    """Number of open connections by client address, and their limits; 0 of an address means no limit."""

    max_total: int
    max_per_address: int
    by_address: Counter[str] = field(default_factory=Counter)

    def open(self, address: str) -> bool:
        """Count a new connection unless that exceeds a limit; return whether it was counted."""
        of_address = self.by_address[address]
        if self.by_address.total() >= self.max_total or 0 < self.max_per_address <= of_address:
            return False
        self.by_address[address] += 1
        return True

    def close(self, address: str) -> None:
        """Count the end of a connection."""
        self.by_address[address] -= 1
        self.by_address += Counter()  # Drops addresses without a connection.


def new_connection_counts(settings: Settings) -> ConnectionCounts:
    """Return counts with the limits of the settings, and allow the process as many files as it needs for them."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = settings.max_connections + _OTHER_FILES
    allowed = max(soft, needed if hard == resource.RLIM_INFINITY else min(hard, needed))
    resource.setrlimit(resource.RLIMIT_NOFILE, (allowed, hard))
    max_total = min(settings.max_connections, max(1, allowed - _OTHER_FILES))
    return ConnectionCounts(max_total, settings.max_connections_per_address)


def limited_protocol(counts: ConnectionCounts, head_seconds: float) -> type[H11Protocol]:
    """Return the HTTP protocol of uvicorn with these limits; a connection that exceeds one is closed."""

    class LimitedProtocol(H11Protocol):
        _address: str | None = None
        _head_timer: asyncio.TimerHandle | None = None

        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            address = str((transport.get_extra_info("peername") or ("",))[0])
            if not counts.open(address):
                transport.abort()
                return
            self._address = address
            super().connection_made(transport)
            self._await_head()

        def connection_lost(self, exc: Exception | None) -> None:
            if self._address is None:  # It was refused.
                return
            counts.close(self._address)
            self._stop_waiting()
            super().connection_lost(exc)

        def data_received(self, data: bytes) -> None:
            self._await_head()
            super().data_received(data)
            if self.conn.their_state is not h11.IDLE:
                self._stop_waiting()

        def _await_head(self) -> None:
            if self._head_timer is None and self.conn.their_state is h11.IDLE:
                self._head_timer = self.loop.call_later(head_seconds, self._close)

        def _stop_waiting(self) -> None:
            if self._head_timer is not None:
                self._head_timer.cancel()
                self._head_timer = None

        def _close(self) -> None:
            self.transport.close()

    return LimitedProtocol
