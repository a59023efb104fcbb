"""Malformed and refused uploads: each is answered in words, and no file is left."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from tests.leaderboard.serving import (
    API,
    DISPOSITION,
    END,
    MULTIPART,
    RawResponse,
    RunServer,
    Server,
    chunked,
    connect,
    exchange,
    multipart_part,
    request_head,
)
from tests.processes import wait_until

MAX_UPLOAD_BYTES = 4_000_000
BEFORE, AFTER = (multipart_part(b"|") + END).split(b"|")
"""Bytes before and after the content of the archive in a multipart body."""
FIELD = 'Content-Disposition: form-data; name="{}"'
NOTE, TOKEN = FIELD.format("note"), FIELD.format("token")


@dataclass(frozen=True)
class UploadServer:
    """Server without workers, a token, and a valid archive."""

    server: Server
    token: str
    sound: bytes

    def post(
        self, body: bytes, *headers: str, kind: str = MULTIPART, path: str = API, length: int | None = None
    ) -> RawResponse:
        """Post a body, with Content-Length unless ``headers`` are given; missing bytes are not sent."""
        length_headers = () if headers else (f"Content-Length: {len(body) if length is None else length}",)
        lines = (f"Authorization: Bearer {self.token}", f"Content-Type: {kind}", *length_headers, *headers)
        ends = length is not None and length > len(body)
        return exchange(self.server.url, request_head(path, lines) + body, ends=ends)


@pytest.fixture(scope="module")
def uploads(small_archive: Path, running_server: RunServer) -> Iterator[UploadServer]:
    with running_server(workers=0, max_upload=MAX_UPLOAD_BYTES) as server:
        yield UploadServer(server, server.token("stranger"), small_archive.read_bytes())
        assert not any("Traceback" in line or '"error"' in line for line in server.log)


@pytest.fixture(autouse=True)
def _leaves_nothing(uploads: UploadServer) -> Iterator[None]:
    yield  # A broken connection is noticed with a delay.
    wait_until(lambda: not uploads.server.spool_files(), "the spool is empty", 10)
    assert uploads.server.get("/healthz").status_code == 200


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("multipart/form-data", "expected multipart/form-data"),
        ('multipart/form-data; boundary=""', "expected multipart/form-data"),
        ("multipart/form-data; boundary=YY", "bytes outside the field"),
        ("multipart/mixed; boundary=XX", "expected multipart/form-data"),
    ],
)
def test_non_multipart_content_type_is_422(uploads: UploadServer, kind: str, words: str) -> None:
    response = uploads.post(multipart_part(uploads.sound) + END, kind=kind)
    assert response.status == 422
    assert words in response.text


BAD_BODIES = {
    "empty": b"",
    "no field archive": multipart_part(b"x", FIELD.format("file")) + END,
    "field twice": multipart_part(b"x") + multipart_part(b"x") + END,
    "field twice, the second empty": multipart_part(b"x") + multipart_part(b"") + END,
    "header of 300 KB": multipart_part(b"x", "X: " + "y" * 300_000, DISPOSITION) + END,
    "end missing": multipart_part(b"x"),
    "end in a header": multipart_part(b"x")[:30],
    "content that is no zip": multipart_part(b"x") + END,
}


@pytest.mark.parametrize("body", BAD_BODIES.values(), ids=BAD_BODIES)
def test_malformed_multipart_body_is_422(uploads: UploadServer, body: bytes) -> None:
    pieces = (body[start : start + 999] for start in range(0, len(body), 999))
    for response in (uploads.post(body), uploads.post(chunked(*pieces), "Transfer-Encoding: chunked")):
        assert response.status == 422, response.text
        assert '"problems":["' in response.text
    form = uploads.post(multipart_part(uploads.token.encode(), TOKEN) + body, path="/submit")
    assert form.status in (401, 422)  # 401 if the body ends before the token does.
    assert "<html" in form.text


def test_file_names_extra_fields_and_epilogue_are_ignored(uploads: UploadServer) -> None:
    disposition = 'Content-Disposition: form-data; name="archive"; filename="../../../../../../tmp/escaped.zip"'
    note = multipart_part(b"y" * 20_000, NOTE)
    body = note + multipart_part(uploads.sound, disposition) + note + END + b"epilogue"
    assert uploads.post(body).status in (200, 202)
    assert not list(Path("/tmp").glob("escaped*"))


def test_wrong_content_length_is_rejected(uploads: UploadServer) -> None:
    body = multipart_part(uploads.sound) + END
    assert uploads.post(body, length=len(body) - 60).status == 422
    assert uploads.post(body, length=len(body) + 60).status is None  # It was closed before a response.


@pytest.mark.parametrize(
    ("after", "status", "words"),
    [
        (b"\r\n" + END + b"y" * 10_000_000, 422, "more than 65536 bytes outside"),
        (b"y" * 10_000_000, 413, f"larger than {MAX_UPLOAD_BYTES} bytes"),
        (b"\r\n" + multipart_part(b"", NOTE) * 100_000, 422, "more than 65536 bytes outside"),
    ],
    ids=["after the end", "in the archive", "in other fields"],
)
def test_body_size_is_limited_everywhere(uploads: UploadServer, after: bytes, status: int, words: str) -> None:
    body = BEFORE + uploads.sound + after
    pieces = [body[offset : offset + 60_000] for offset in range(0, len(body), 60_000)]
    response = uploads.post(chunked(*pieces), "Transfer-Encoding: chunked")
    assert response.status == status
    assert words in response.text


def test_randomly_damaged_body_is_422(uploads: UploadServer) -> None:
    random = np.random.default_rng(20261122)
    valid_body = multipart_part(b"PK\3\4", DISPOSITION, "Content-Type: application/zip") + END
    for _ in range(40):
        body = bytearray(valid_body)
        for position in random.integers(len(body), size=random.integers(1, 6)):
            body[position] = random.choice(np.frombuffer(b'\0\r\n:;="-\\ \t\xffX', np.uint8))
        assert uploads.post(bytes(body)).status == 422, bytes(body)


@pytest.mark.parametrize(
    ("method", "headers", "status", "words"),
    [
        ("POST", ("Authorization: Bearer nobody's", "Expect: 100-continue"), 401, "the token is unknown"),
        ("PUT", (), 401, "no token"),
        ("POST", ("Authorization: Bearer {}",), 413, "the limit of this service"),
        ("PUT", ("Authorization: Bearer {}",), 413, "the limit of this service"),
    ],
)
def test_refusal_comes_before_the_body(
    uploads: UploadServer, method: str, headers: tuple[str, ...], status: int, words: str
) -> None:
    kind = MULTIPART if method == "POST" else "application/zip"
    lines = [line.format(uploads.token) for line in headers]
    lines += [f"Content-Type: {kind}", "Content-Length: 99000000000"]
    with connect(uploads.server.url) as connection:
        connection.sendall(request_head(API, lines, method=method))
        answer = b""
        while not answer.endswith(b"}") and (chunk := connection.recv(1 << 16)):
            answer += chunk
    assert answer.startswith(f"HTTP/1.1 {status} ".encode()), answer
    assert words.encode() in answer
