"""Raw HTTP over a socket: requests that HTTP clients would not send."""

from __future__ import annotations

import re
import socket
from collections.abc import Iterable
from dataclasses import dataclass
from urllib.parse import urlsplit

BOUNDARY = "XX"
MULTIPART = f"multipart/form-data; boundary={BOUNDARY}"
DISPOSITION = 'Content-Disposition: form-data; name="archive"; filename="a.zip"'


@dataclass(frozen=True)
class RawResponse:
    """Status, which is None if the connection ended without one, and the full text of a response."""

    status: int | None
    text: str


def connect(url: str, timeout_s: float = 30) -> socket.socket:
    """Return a connection to the server at ``url``."""
    address = urlsplit(url)
    return socket.create_connection((address.hostname or "", address.port or 80), timeout=timeout_s)


def request_head(path: str, headers: Iterable[str], method: str = "POST") -> bytes:
    """Return the request line and headers, with ``Connection: close``."""
    lines = (f"{method} {path} HTTP/1.1", "Host: test", "Connection: close", *headers, "", "")
    return "\r\n".join(lines).encode("latin-1")


def exchange(url: str, data: bytes, *, ends: bool = False) -> RawResponse:
    """Send ``data``, shut down sending if ``ends`` (the body is incomplete), and return the response."""
    with connect(url) as connection:
        try:
            connection.sendall(data)
            if ends:
                connection.shutdown(socket.SHUT_WR)
        except OSError:
            pass  # The server has responded and closed; its response can still be read.
        return read_response(connection)


def read_response(connection: socket.socket) -> RawResponse:
    """Read a response until the server closes the connection."""
    data = b""
    try:
        while chunk := connection.recv(1 << 16):
            data += chunk
    except ConnectionResetError:
        pass
    match = re.match(rb"HTTP/1\.1 (\d{3}) ", data.removeprefix(b"HTTP/1.1 100 Continue\r\n\r\n"))
    return RawResponse(int(match[1]) if match else None, data.decode("utf-8", "replace"))


def multipart_part(content: bytes, *headers: str) -> bytes:
    """Return a multipart part with its boundary line: the field ``archive`` unless ``headers`` are given."""
    lines = (f"--{BOUNDARY}", *(headers or (DISPOSITION,)), "", "")
    return "\r\n".join(lines).encode("latin-1") + content + b"\r\n"


END = f"--{BOUNDARY}--\r\n".encode()


def chunked(*pieces: bytes) -> bytes:
    """Return a body in chunked transfer encoding."""
    return b"".join(b"%x\r\n%s\r\n" % (len(piece), piece) for piece in pieces) + b"0\r\n\r\n"
