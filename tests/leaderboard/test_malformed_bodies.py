"""Bodies that are no multipart, or a strange one: each is answered in words, and leaves nothing behind."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx2
import numpy as np
import pytest

from tests.leaderboard.conftest import Write
from tests.leaderboard.processes import memory_bytes, open_files
from tests.leaderboard.raw_http import BOUNDARY, DISPOSITION, END, MULTIPART, Answer, chunked, exchange, head, part
from tests.leaderboard.serving import Server, running_server

API = "/api/v1/submissions"
MOST_UPLOAD = 400_000
NAMED = 'Content-Disposition: form-data; name="{}"'


@dataclass(frozen=True)
class Besieged:
    """A server that takes uploads and scores none, a token of it, and a sound archive."""

    server: Server
    token: str
    sound: bytes

    def post(
        self, body: bytes, *headers: str, kind: str = MULTIPART, path: str = API, length: int | None = None
    ) -> Answer:
        """Post a body; its length is told unless ``headers`` say else. What it lacks of ``length`` never comes."""
        told = () if headers else (f"Content-Length: {len(body) if length is None else length}",)
        lines = (f"Authorization: Bearer {self.token}", f"Content-Type: {kind}", *told, *headers)
        ends = length is not None and length > len(body)
        return exchange(self.server.url, head(path, lines) + body, ends=ends)

    def left(self) -> list[Path]:
        """Return the files of uploads under way."""
        return list((self.server.state / "spool").glob("*/*"))


@pytest.fixture(scope="module")
def besieged(
    tiny_root: Path, write_archive: Write, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Besieged]:
    state = tmp_path_factory.mktemp("bodies") / "state"
    often = "1000000/minute"
    sound = write_archive("sound", configs=("lattice-orbit",)).read_bytes()
    with running_server(
        tiny_root, state, scorers=0, quota=10**6, reads=often, writes=often, max_upload=MOST_UPLOAD
    ) as server:
        yield Besieged(server, server.token("stranger"), sound)
        assert not any("Traceback" in line for line in server.log)


@pytest.fixture(autouse=True)
def _leaves_nothing(besieged: Besieged) -> Iterator[None]:
    yield
    limit = time.monotonic() + 10  # who broke off is noticed a moment later
    while besieged.left() and time.monotonic() < limit:
        time.sleep(0.05)
    assert besieged.left() == []
    assert httpx2.get(f"{besieged.server.url}/healthz").status_code == 200


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("multipart/form-data", "expected multipart/form-data"),
        ("multipart/form-data; boundary=", "expected multipart/form-data"),
        ('multipart/form-data; boundary=""', "expected multipart/form-data"),
        ("multipart/form-data; boundary*=utf-8''XX", "expected multipart/form-data"),
        ("multipart/form-data; boundary=" + "X" * 10_000, "no multipart/form-data"),
        ("multipart/form-data; boundary=YY", "no multipart/form-data"),
        ("multipart/mixed; boundary=XX", "expected multipart/form-data"),
        ("application/zip", "expected multipart/form-data"),
        ("\xff\xfe", "expected multipart/form-data"),
        ("", "expected multipart/form-data"),
    ],
)
def test_types_that_are_not_multipart(besieged: Besieged, kind: str, words: str) -> None:
    answer = besieged.post(part(besieged.sound) + END, kind=kind)
    assert answer.status == 422
    assert words in answer.text


BAD_BODIES = {
    "empty": b"",
    "no part": END,
    "no field archive": part(b"x", NAMED.format("file")) + END,
    "no disposition": part(b"x", "Content-Type: application/zip") + END,
    "name of another spelling": part(b"x", "Content-Disposition: form-data; name*=utf-8''archive") + END,
    "field twice": part(b"x") + part(b"x") + END,
    "field twice, the second empty": part(b"x") + part(b"") + END,
    "70 KB of another field": part(b"x" * 70_000, NAMED.format("note")) + part(b"x") + END,
    "2000 fields": part(b"", NAMED.format("note")) * 2000 + part(b"x") + END,
    "70 KB after the end": part(b"x") + END + b"y" * 70_000,
    "header of 300 KB": part(b"x", "X: " + "y" * 300_000, DISPOSITION) + END,
    "1000 headers": part(b"x", *[f"X-{number}: y" for number in range(1000)], DISPOSITION) + END,
    "header without colon": part(b"x", "Content-Disposition") + END,
    "NUL in a header's name": part(b"x", "Content\0Disposition: form-data") + END,
    "bare line feeds": (part(b"x") + END).replace(b"\r\n", b"\n"),
    "junk in front": b"junk" + part(b"x") + END,
    "end missing": part(b"x"),
    "end in a header": part(b"x")[:30],
    "end in the boundary": part(b"x") + END[:3],
    "content that is no zip": part(b"x") + END,
    "boundary inside": part(f"a\r\n--{BOUNDARY}--\r\nb".encode()) + END,
}


@pytest.mark.parametrize("name", BAD_BODIES)
def test_bodies_that_are_refused(besieged: Besieged, name: str) -> None:
    for answer in (
        besieged.post(BAD_BODIES[name]),
        besieged.post(
            chunked(*(BAD_BODIES[name][at : at + 999] for at in range(0, len(BAD_BODIES[name]), 999))),
            "Transfer-Encoding: chunked",
        ),
    ):
        assert answer.status == 422, answer.text
        assert '"problems":["' in answer.text
    form = besieged.post(part(besieged.token.encode(), NAMED.format("token")) + BAD_BODIES[name], path="/submit")
    assert form.status in (401, 422)  # 401 where the body breaks before the token ends
    assert "<html" in form.text


@pytest.mark.parametrize(
    "disposition",
    [
        'Content-Disposition: form-data; name="archive"; filename="../../../../../../tmp/escaped.zip"',
        'Content-Disposition: form-data; name="archive"; filename="C:\\up.zip"; filename*=utf-8\'\'%2e%2e%2fup',
        "content-disposition: form-data; name=archive",
        'CONTENT-DISPOSITION:form-data;name="archive";x="' + "y" * 3000 + '"',
    ],
)
def test_names_of_files_are_nothing_to_us(besieged: Besieged, disposition: str) -> None:
    assert besieged.post(part(besieged.sound, disposition) + END).status == 202
    assert not list(Path("/tmp").glob("escaped*"))


def test_what_stands_around_the_archive_may_be_strange(besieged: Besieged) -> None:
    note = part(b"y" * 30_000, NAMED.format("note"))
    assert besieged.post(note + part(besieged.sound) + note + END + b"epilogue").status == 202


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
def test_lengths_that_are_none(besieged: Besieged, headers: tuple[str, ...], status: int) -> None:
    assert besieged.post(part(b"x") + END, *headers).status == status


@pytest.mark.parametrize(
    "body", [b"zz\r\nxx\r\n0\r\n\r\n", b"3\r\nxxxxxx\r\n0\r\n\r\n", b"-1\r\nx\r\n", b"5;" + b"y" * 100_000]
)
def test_chunks_that_are_none(besieged: Besieged, body: bytes) -> None:
    assert besieged.post(body, "Transfer-Encoding: chunked").status == 400


def test_a_length_that_is_not_the_bodys(besieged: Besieged) -> None:
    body = part(besieged.sound) + END
    assert besieged.post(body, length=len(body) - 60).status == 422
    assert besieged.post(body, length=len(body) + 60).status is None  # it broke off: there is nobody to be told


@pytest.mark.parametrize("where", ["after the end", "in the archive", "in other fields"])
def test_no_body_is_endless(besieged: Besieged, where: str) -> None:
    start = part(besieged.sound)[:-2]
    body, status, words = {
        "after the end": (start + b"\r\n" + END + b"y" * 10_000_000, 422, "more than 65536 bytes beside"),
        "in the archive": (start + b"y" * 10_000_000, 413, f"larger than {MOST_UPLOAD} bytes"),
        "in other fields": (part(b"", NAMED.format("note")) * 100_000, 422, "more than 65536 bytes beside"),
    }[where]
    pieces = [body[at : at + 60_000] for at in range(0, len(body), 60_000)]
    answer = besieged.post(chunked(*pieces), "Transfer-Encoding: chunked")
    assert answer.status == status
    assert words in answer.text


def test_random_damage_is_answered(besieged: Besieged) -> None:
    random = np.random.default_rng(20261122)
    sound = part(b"PK\3\4", DISPOSITION, "Content-Type: application/zip") + END
    for _ in range(300):
        body = bytearray(sound)
        for at in random.integers(len(body), size=random.integers(1, 6)):
            body[at] = random.choice(np.frombuffer(b'\0\r\n:;="-\\ \t\xffX', np.uint8))
        assert besieged.post(bytes(body)).status == 422, bytes(body)


def test_words_that_are_no_method_are_counted_as_one(besieged: Besieged) -> None:
    before = memory_bytes(besieged.server.process.pid), open_files(besieged.server.process.pid)
    for number in range(300):
        assert exchange(besieged.server.url, head("/healthz", (), method=f"WORD{number}")).status == 405
    metrics = httpx2.get(f"{besieged.server.url}/metrics").text
    assert not re.search("WORD[0-9]", metrics)
    assert re.search(r'rebar_requests_total\{method="other",route="/healthz",status="405"\} 300', metrics)
    after = memory_bytes(besieged.server.process.pid), open_files(besieged.server.process.pid)
    assert after[0] - before[0] < 4 << 20
    assert after[1] <= before[1] + 2
