"""Local HTTP server with the Hub's file API."""

from __future__ import annotations

import hashlib
import json
from http.server import BaseHTTPRequestHandler
from pathlib import Path

COMMIT = "0123456789abcdef0123456789abcdef01234567"


class HubRequestHandler(BaseHTTPRequestHandler):
    """Request handler with the endpoints that the Hub client uses: the file list and the files of one model.

    Every request is appended to ``requests`` as "METHOD PATH".
    """

    def __init__(self, folder: Path, requests: list[str], *rest: object) -> None:
        self.folder, self.requests = folder, requests
        super().__init__(*rest)  # type: ignore[arg-type]

    def do_GET(self) -> None:
        self.answer(with_body=True)

    def do_HEAD(self) -> None:
        self.answer(with_body=False)

    def log_message(self, *_: object) -> None:
        """Suppress the request log."""

    def answer(self, with_body: bool) -> None:
        path, _, _ = self.path.partition("?")
        self.requests.append(f"{self.command} {path}")
        if path.startswith("/api/models/org/model/tree"):
            entries = [
                {"type": "file", "path": entry.name, "size": entry.stat().st_size, "oid": file_sha1(entry)}
                for entry in sorted(self.folder.iterdir())
            ]
            self.reply(200, json.dumps(entries).encode(), {}, with_body)
        elif path.startswith("/api/models/org/model"):
            files = [
                {"rfilename": entry.name, "size": entry.stat().st_size} for entry in sorted(self.folder.iterdir())
            ]
            model_info = {"id": "org/model", "modelId": "org/model", "sha": COMMIT, "siblings": files}
            self.reply(200, json.dumps(model_info).encode(), {}, with_body)
        elif path.startswith("/org/model/resolve/") and (file := self.folder / Path(path).name).is_file():
            self.reply(
                200, file.read_bytes(), {"ETag": f'"{file_sha1(file)}"', "X-Repo-Commit": COMMIT}, with_body
            )
        else:
            code = "EntryNotFound" if path.startswith("/org/model/") else "RepoNotFound"
            self.reply(404, b"{}", {"X-Error-Code": code}, with_body)

    def reply(self, status: int, body: bytes, headers: dict[str, str], with_body: bool) -> None:
        self.send_response(status)
        for name, value in {**headers, "Content-Length": str(len(body))}.items():
            self.send_header(name, value)
        self.end_headers()
        if with_body:
            self.wfile.write(body)


def file_sha1(path: Path) -> str:
    """Return the SHA-1 of a file in hexadecimal, used as ETag and object id."""
    return hashlib.sha1(path.read_bytes()).hexdigest()
