"""TCP server that gives prepared answers to the requests of the leaderboard's client."""

from __future__ import annotations

import hashlib
import json
import re
import socketserver
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from io import BufferedIOBase
from pathlib import Path
from typing import Any

from rebar_depth_bench.cli.main import main
from rebar_depth_bench.remote.models import Submission

Send = Callable[[BufferedIOBase], None]
"""Function that writes an answer to a connection."""
SUBMISSION: dict[str, Any] = Submission.model_json_schema()["example"]
ID, URL = SUBMISSION["id"], SUBMISSION["url"]
TOKEN = "rdb_secret-of-the-user"
TOKEN_INFO = {
    "name": "alice",
    "quota": 10,
    "quota_left": 9,
    "quota_bytes": 1 << 40,
    "quota_bytes_left": 1 << 39,
    "max_upload_bytes": 1 << 30,
}


@dataclass
class ScriptedServer:
    """Running server: its URL, answers by endpoint (token, submit, status, result), and heads of the requests.

    The last answer of an endpoint is repeated.
    """

    url: str
    answers: dict[str, list[bytes | Send]] = field(default_factory=dict)
    requests: list[tuple[str, str]] = field(default_factory=list)

    def endpoints(self) -> list[str]:
        """Return the endpoints that were asked, in order."""
        return [endpoint for endpoint, _ in self.requests]

    def submit(self, archive: Path, *options: str) -> int:
        """Run ``rebar-bench submit`` in this process; return its exit status."""
        return main(["submit", str(archive), "--url", self.url, *options])


def answer(content: object, status: int = 200, headers: Mapping[str, str] | None = None) -> bytes:
    """Return a complete HTTP response; content other than bytes becomes JSON."""
    body = content if isinstance(content, bytes) else json.dumps(content).encode()
    lines = {"Content-Length": str(len(body)), "Connection": "close", **(headers or {})}
    head = "".join(f"{name}: {value}\r\n" for name, value in lines.items())
    return f"HTTP/1.1 {status} Answer\r\n{head}\r\n".encode() + body


def submission(archive: Path, **changes: Any) -> dict[str, Any]:
    """Return the JSON of an accepted submission with some values changed; a value of ``...`` is left out."""
    values = {**SUBMISSION, "archive_sha256": hashlib.sha256(archive.read_bytes()).hexdigest(), **changes}
    return {key: value for key, value in values.items() if value is not ...}


@contextmanager
def scripted_server() -> Iterator[ScriptedServer]:
    """Run a server until the block ends."""
    script = ScriptedServer("")

    class Handler(socketserver.StreamRequestHandler):
        def handle(self) -> None:
            head = b""
            while not head.endswith(b"\r\n\r\n") and (line := self.rfile.readline()):
                head += line
            if not head:
                return
            if length := re.search(rb"content-length: (\d+)", head, re.IGNORECASE):
                self.rfile.read(int(length[1]))
            method, path = head.split(b" ", 2)[:2]
            endpoint = path.decode("latin-1").rpartition("/")[2].removesuffix(".json")
            if endpoint not in ("token", "result"):
                endpoint = "submit" if method == b"PUT" else "status"
            script.requests.append((endpoint, head.decode("latin-1")))
            answers = script.answers[endpoint]
            response = answers.pop(0) if len(answers) > 1 else answers[0]
            with suppress(OSError):  # The client may close the connection at any time.
                if callable(response):
                    response(self.wfile)
                else:
                    self.wfile.write(response)

    class Server(socketserver.ThreadingTCPServer):
        daemon_threads = True
        allow_reuse_address = True

    with Server(("127.0.0.1", 0), Handler) as server:
        script.url = f"http://127.0.0.1:{server.server_address[1]}"
        thread = threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True)
        thread.start()
        try:
            yield script
        finally:
            server.shutdown()
            thread.join(10)
