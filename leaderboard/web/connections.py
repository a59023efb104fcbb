"""Limits on connections: their number in total and per address, and the time for the head of a request."""

from __future__ import annotations

import asyncio
import resource
from collections import Counter
from dataclasses import dataclass, field

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from leaderboard.settings import Settings

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
