"""Malformed and unusual multipart bodies: each gets a readable response and leaves no file."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx2
import numpy as np
import pytest

from tests.leaderboard.conftest import WriteArchive
from tests.leaderboard.raw_http import (
    BOUNDARY,
    DISPOSITION,
    END,
    MULTIPART,
    RawResponse,
    chunked,
    exchange,
    multipart_part,
    request_head,
)
from tests.leaderboard.serving import RunServer, Server
from tests.processes import memory_bytes, num_open_files

API = "/api/v1/submissions"
MAX_UPLOAD_BYTES = 400_000
DISPOSITION_WITH_NAME = 'Content-Disposition: form-data; name="{}"'


@dataclass(frozen=True)
class UploadServer:
    """Server without workers, a token and a valid archive."""

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

    def spool_files(self) -> list[Path]:
        """Return the spool files of unfinished uploads."""
        return list((self.server.state / "spool").iterdir())


@pytest.fixture(scope="module")
def upload_server(
    tiny_root: Path,
    write_archive: WriteArchive,
    tmp_path_factory: pytest.TempPathFactory,
    running_server: RunServer,
) -> Iterator[UploadServer]:
    state = tmp_path_factory.mktemp("bodies") / "state"
    often = "1000000/minute"
    sound = write_archive("sound", configs=("lattice-orbit",)).read_bytes()
    with running_server(
        tiny_root,
        state,
        workers=0,
        quota=10**6,
        read_rate_limit=often,
        write_rate_limit=often,
        max_upload=MAX_UPLOAD_BYTES,
    ) as server:
        yield UploadServer(server, server.token("stranger"), sound)
        assert not any("Traceback" in line for line in server.log)


@pytest.fixture(autouse=True)
def _leaves_nothing(upload_server: UploadServer) -> Iterator[None]:
    yield
    deadline = time.monotonic() + 10  # A broken connection is noticed with a delay.
    while upload_server.spool_files() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert upload_server.spool_files() == []
    assert httpx2.get(f"{upload_server.server.url}/healthz").status_code == 200


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("multipart/form-data", "expected multipart/form-data"),
        ("multipart/form-data; boundary=", "expected multipart/form-data"),
        ('multipart/form-data; boundary=""', "expected multipart/form-data"),
        ("multipart/form-data; boundary*=utf-8''XX", "expected multipart/form-data"),
        ("multipart/form-data; boundary=" + "X" * 10_000, "bytes outside the field"),
        ("multipart/form-data; boundary=YY", "bytes outside the field"),
        ("multipart/mixed; boundary=XX", "expected multipart/form-data"),
        ("application/zip", "expected multipart/form-data"),
        ("\xff\xfe", "expected multipart/form-data"),
        ("", "expected multipart/form-data"),
    ],
)
def test_non_multipart_content_type_is_422(upload_server: UploadServer, kind: str, words: str) -> None:
    response = upload_server.post(multipart_part(upload_server.sound) + END, kind=kind)
    assert response.status == 422
    assert words in response.text


BAD_BODIES = {
    "empty": b"",
    "no part": END,
    "no field archive": multipart_part(b"x", DISPOSITION_WITH_NAME.format("file")) + END,
    "no disposition": multipart_part(b"x", "Content-Type: application/zip") + END,
    "name of another spelling": multipart_part(b"x", "Content-Disposition: form-data; name*=utf-8''archive") + END,
    "field twice": multipart_part(b"x") + multipart_part(b"x") + END,
    "field twice, the second empty": multipart_part(b"x") + multipart_part(b"") + END,
    "70 KB of another field": multipart_part(b"x" * 70_000, DISPOSITION_WITH_NAME.format("note"))
    + multipart_part(b"x")
    + END,
    "2000 fields": multipart_part(b"", DISPOSITION_WITH_NAME.format("note")) * 2000 + multipart_part(b"x") + END,
    "70 KB after the end": multipart_part(b"x") + END + b"y" * 70_000,
    "header of 300 KB": multipart_part(b"x", "X: " + "y" * 300_000, DISPOSITION) + END,
    "1000 headers": multipart_part(b"x", *[f"X-{number}: y" for number in range(1000)], DISPOSITION) + END,
    "header without colon": multipart_part(b"x", "Content-Disposition") + END,
    "NUL in a header's name": multipart_part(b"x", "Content\0Disposition: form-data") + END,
    "bare line feeds": (multipart_part(b"x") + END).replace(b"\r\n", b"\n"),
    "junk in front": b"junk" + multipart_part(b"x") + END,
    "end missing": multipart_part(b"x"),
    "end in a header": multipart_part(b"x")[:30],
    "end in the boundary": multipart_part(b"x") + END[:3],
    "content that is no zip": multipart_part(b"x") + END,
    "boundary inside": multipart_part(f"a\r\n--{BOUNDARY}--\r\nb".encode()) + END,
}


@pytest.mark.parametrize("name", BAD_BODIES)
def test_malformed_multipart_body_is_422(upload_server: UploadServer, name: str) -> None:
    for response in (
        upload_server.post(BAD_BODIES[name]),
        upload_server.post(
            chunked(*(BAD_BODIES[name][start : start + 999] for start in range(0, len(BAD_BODIES[name]), 999))),
            "Transfer-Encoding: chunked",
        ),
    ):
        assert response.status == 422, response.text
        assert '"problems":["' in response.text
    form_response = upload_server.post(
        multipart_part(upload_server.token.encode(), DISPOSITION_WITH_NAME.format("token")) + BAD_BODIES[name],
        path="/submit",
    )
    assert form_response.status in (401, 422)  # 401 if the body ends before the token does.
    assert "<html" in form_response.text


@pytest.mark.parametrize(
    "disposition",
    [
        'Content-Disposition: form-data; name="archive"; filename="../../../../../../tmp/escaped.zip"',
        'Content-Disposition: form-data; name="archive"; filename="C:\\up.zip"; filename*=utf-8\'\'%2e%2e%2fup',
        "content-disposition: form-data; name=archive",
        'CONTENT-DISPOSITION:form-data;name="archive";x="' + "y" * 3000 + '"',
    ],
)
def test_file_names_in_disposition_are_ignored(upload_server: UploadServer, disposition: str) -> None:
    assert upload_server.post(multipart_part(upload_server.sound, disposition) + END).status in (200, 202)
    assert not list(Path("/tmp").glob("escaped*"))


def test_extra_fields_and_epilogue_are_accepted(upload_server: UploadServer) -> None:
    note = multipart_part(b"y" * 30_000, DISPOSITION_WITH_NAME.format("note"))
    assert upload_server.post(note + multipart_part(upload_server.sound) + note + END + b"epilogue").status in (
        200,
        202,
    )


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        (("Content-Length: -1",), 400),
        (("Content-Length: ten",), 400),
        (("Content-Length: 10", "Content-Length: 11"), 400),
        (("Content-Length: 9" + "9" * 18,), 413),
        (("Content-Length: 9" + "9" * 300,), 400),
        (("Transfer-Encoding: gzip",), 400),
        (("Transfer-Encoding: chunked", "Transfer-Encoding: chunked"), 400),
        (("X: " + "y" * 1_000_000, "Content-Length: 0"), 400),
    ],
)
def test_invalid_lengths_are_rejected(upload_server: UploadServer, headers: tuple[str, ...], status: int) -> None:
    assert upload_server.post(multipart_part(b"x") + END, *headers).status == status


@pytest.mark.parametrize(
    "body", [b"zz\r\nxx\r\n0\r\n\r\n", b"3\r\nxxxxxx\r\n0\r\n\r\n", b"-1\r\nx\r\n", b"5;" + b"y" * 100_000]
)
def test_invalid_chunks_are_400(upload_server: UploadServer, body: bytes) -> None:
    assert upload_server.post(body, "Transfer-Encoding: chunked").status == 400


def test_wrong_content_length_is_rejected(upload_server: UploadServer) -> None:
    body = multipart_part(upload_server.sound) + END
    assert upload_server.post(body, length=len(body) - 60).status == 422
    assert (
        upload_server.post(body, length=len(body) + 60).status is None
    )  # The connection was closed before a response.


@pytest.mark.parametrize("where", ["after the end", "in the archive", "in other fields"])
def test_body_size_is_limited_everywhere(upload_server: UploadServer, where: str) -> None:
    start = multipart_part(upload_server.sound)[:-2]
    body, status, words = {
        "after the end": (start + b"\r\n" + END + b"y" * 10_000_000, 422, "more than 65536 bytes outside"),
        "in the archive": (start + b"y" * 10_000_000, 413, f"larger than {MAX_UPLOAD_BYTES} bytes"),
        "in other fields": (
            multipart_part(b"", DISPOSITION_WITH_NAME.format("note")) * 100_000,
            422,
            "more than 65536 bytes outside",
        ),
    }[where]
    pieces = [body[offset : offset + 60_000] for offset in range(0, len(body), 60_000)]
    response = upload_server.post(chunked(*pieces), "Transfer-Encoding: chunked")
    assert response.status == status
    assert words in response.text


def test_randomly_damaged_body_is_422(upload_server: UploadServer) -> None:
    random = np.random.default_rng(20261122)
    valid_body = multipart_part(b"PK\3\4", DISPOSITION, "Content-Type: application/zip") + END
    for _ in range(300):
        body = bytearray(valid_body)
        for position in random.integers(len(body), size=random.integers(1, 6)):
            body[position] = random.choice(np.frombuffer(b'\0\r\n:;="-\\ \t\xffX', np.uint8))
        assert upload_server.post(bytes(body)).status == 422, bytes(body)


def test_unknown_methods_leave_nothing_in_memory(upload_server: UploadServer) -> None:
    before = memory_bytes(upload_server.server.process.pid), num_open_files(upload_server.server.process.pid)
    for number in range(300):
        assert (
            exchange(upload_server.server.url, request_head("/healthz", (), method=f"WORD{number}")).status == 405
        )
    after = memory_bytes(upload_server.server.process.pid), num_open_files(upload_server.server.process.pid)
    assert after[0] - before[0] < 4 << 20
    assert after[1] <= before[1] + 2
