"""HTTP by hand, over a socket: requests that no client would send."""

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
class Answer:
    """What came back: the status, None where the connection ended without one, and everything that was said."""

    status: int | None
    text: str


def connect(url: str, timeout_s: float = 30) -> socket.socket:
    """Return a connection to the server at ``url``."""
    address = urlsplit(url)
    return socket.create_connection((address.hostname or "", address.port or 80), timeout=timeout_s)


def head(path: str, headers: Iterable[str], method: str = "POST") -> bytes:
    """Return a request's head; the server is asked to close after its answer."""
    lines = (f"{method} {path} HTTP/1.1", "Host: test", "Connection: close", *headers, "", "")
    return "\r\n".join(lines).encode("latin-1")


def exchange(url: str, data: bytes, *, ends: bool = False) -> Answer:
    """Send ``data``, then the end of all sending if the body ``ends`` early, and return the answer."""
    with connect(url) as connection:
        try:
            connection.sendall(data)
            if ends:
                connection.shutdown(socket.SHUT_WR)
        except OSError:
            pass  # it has answered and closed: what it said is still there to be read
        return answer_of(connection)


def answer_of(connection: socket.socket) -> Answer:
    """Read an answer until the server closes."""
    said = b""
    try:
        while part := connection.recv(1 << 16):
            said += part
    except ConnectionResetError:
        pass
    found = re.match(rb"HTTP/1\.1 (\d{3}) ", said.removeprefix(b"HTTP/1.1 100 Continue\r\n\r\n"))
    return Answer(int(found[1]) if found else None, said.decode("utf-8", "replace"))


def part(content: bytes, *headers: str) -> bytes:
    """Return a part of a multipart body, with the line before it: the archive unless ``headers`` say else."""
    lines = (f"--{BOUNDARY}", *(headers or (DISPOSITION,)), "", "")
    return "\r\n".join(lines).encode("latin-1") + content + b"\r\n"


END = f"--{BOUNDARY}--\r\n".encode()


def chunked(*pieces: bytes) -> bytes:
    """Return a body in chunks, with its end."""
    return b"".join(b"%x\r\n%s\r\n" % (len(piece), piece) for piece in pieces) + b"0\r\n\r\n"
