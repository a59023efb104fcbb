"""Refusals reach a client that is still sending, whatever client it is: none sees only a cut connection."""

from __future__ import annotations

import shutil
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import httpx2
import pytest

from tests.leaderboard.conftest import Write
from tests.leaderboard.raw_http import END, MULTIPART, Answer, answer_of, connect, head, part
from tests.leaderboard.serving import Server, running_server

API = "/api/v1/submissions"
MOST_UPLOAD = 4_000_000
PIECE = bytes(1 << 16)


@dataclass(frozen=True)
class Refusal:
    """An upload that is refused before it has come whole: token, size of the body, whether it is chunked."""

    status: int
    words: str
    token: str
    size: int
    is_chunked: bool = False


@dataclass(frozen=True)
class Refusing:
    """A server, and a token whose quota is spent and one that has a place left."""

    server: Server
    spent: str
    fresh: str

    def refusals(self) -> Mapping[str, Refusal]:
        small, large = MOST_UPLOAD // 2, 5 * MOST_UPLOAD
        too_large = "the archive is larger than 4000000 bytes"
        return {
            "unknown token": Refusal(401, "the token is unknown", "nobody's", small),
            "unknown token, large": Refusal(401, "the token is unknown", "nobody's", large),
            "unknown token, chunked": Refusal(401, "the token is unknown", "nobody's", large, True),
            "too large": Refusal(413, too_large, self.fresh, large),
            "too large, chunked": Refusal(413, too_large, self.fresh, large, True),
            "no quota": Refusal(429, "this token has made its 1 submissions of today (UTC)", self.spent, small),
            "no quota, large": Refusal(429, "this token has made its 1 submissions", self.spent, large, True),
        }


REFUSALS = tuple(Refusing.refusals(Refusing(None, "", "")))  # type: ignore[arg-type]
Client = Callable[[str, Refusal, Path], Answer]


def by_socket(url: str, refusal: Refusal, _: Path) -> Answer:
    """A client that sends everything before it listens."""
    before, after = (part(b"|") + END).split(b"|")
    length = f"Content-Length: {len(before) + refusal.size + len(after)}"
    told = "Transfer-Encoding: chunked" if refusal.is_chunked else length
    lines = (f"Authorization: Bearer {refusal.token}", f"Content-Type: {MULTIPART}", told)
    pieces = [before, *[PIECE] * (refusal.size // len(PIECE)), bytes(refusal.size % len(PIECE)), after]
    with connect(url) as connection:
        try:
            connection.sendall(head(API, lines))
            for piece in pieces:
                connection.sendall(b"%x\r\n%s\r\n" % (len(piece), piece) if refusal.is_chunked else piece)
            connection.sendall(b"0\r\n\r\n" if refusal.is_chunked else b"")
        except ConnectionError:
            pass
        return answer_of(connection)


def by_httpx(url: str, refusal: Refusal, _: Path) -> Answer:
    before, after = (part(b"|") + END).split(b"|")
    headers = {"Authorization": f"Bearer {refusal.token}", "Content-Type": MULTIPART}

    def pieces() -> Iterator[bytes]:
        yield before
        yield from [PIECE] * (refusal.size // len(PIECE))
        yield bytes(refusal.size % len(PIECE)) + after

    content = pieces() if refusal.is_chunked else b"".join(pieces())
    answer = httpx2.post(url + API, content=content, headers=headers, timeout=60)
    return Answer(answer.status_code, answer.text)


def by_curl(url: str, refusal: Refusal, folder: Path, *more: str) -> Answer:
    """What the page tells people to run; curl waits for 100 Continue before a large body."""
    curl = shutil.which("curl")
    if curl is None:
        pytest.skip("there is no curl on the PATH")
    archive, said = folder / "a.zip", folder / "said.json"
    with archive.open("wb") as file:
        file.truncate(refusal.size)
    command = [curl, "-sS", "-o", str(said), "-w", "%{http_code}", "-F", f"archive=@{archive}", *more]
    command += ["-H", f"Authorization: Bearer {refusal.token}"]
    command += ["-H", "Transfer-Encoding: chunked"] if refusal.is_chunked else []
    told = subprocess.run([*command, url + API], capture_output=True, text=True, check=False, timeout=60)
    assert told.returncode == 0, told.stderr
    return Answer(int(told.stdout), said.read_text())


def by_curl_at_once(url: str, refusal: Refusal, folder: Path) -> Answer:
    return by_curl(url, refusal, folder, "-H", "Expect:")


CLIENTS: Mapping[str, Client] = {
    "socket": by_socket,
    "httpx2": by_httpx,
    "curl": by_curl,
    "curl at once": by_curl_at_once,
}


@pytest.fixture(scope="module")
def refusing(
    tiny_root: Path, write_archive: Write, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Refusing]:
    state = tmp_path_factory.mktemp("refusing") / "state"
    often = "100000/minute"
    with running_server(
        tiny_root, state, scorers=0, quota=1, reads=often, writes=often, max_upload=MOST_UPLOAD
    ) as server:
        spent = server.token("spent")
        server.accepted(write_archive("first", configs=("lattice-orbit",)), spent)
        yield Refusing(server, spent, server.token("fresh"))


@pytest.mark.parametrize("client", CLIENTS)
@pytest.mark.parametrize("why", REFUSALS)
def test_a_refusal_reaches_a_client_that_is_still_sending(
    refusing: Refusing, tmp_path: Path, why: str, client: str
) -> None:
    refusal = refusing.refusals()[why]
    answer = CLIENTS[client](refusing.server.url, refusal, tmp_path)
    assert answer.status == refusal.status
    assert refusal.words in answer.text
    assert list((refusing.server.state / "spool").glob("*/*")) == []
    assert not any("Traceback" in line for line in refusing.server.log)


def test_a_client_that_waits_for_continue_sends_nothing_when_it_is_refused(refusing: Refusing) -> None:
    lines = ("Authorization: Bearer nobody's", f"Content-Type: {MULTIPART}", "Content-Length: 1000000000")
    with connect(refusing.server.url, timeout_s=30) as connection:
        connection.sendall(head(API, (*lines, "Expect: 100-continue")))
        answer = answer_of(connection)
    assert answer.status == 401
    assert "100 Continue" not in answer.text


@pytest.mark.parametrize("why", ["unknown token", "no quota"])
def test_a_client_that_sends_on_and_on_is_not_cut_off(refusing: Refusing, why: str) -> None:
    """Many clients report the connection that broke while they were sending, and never read the answer."""
    refusal = refusing.refusals()[why]
    lines = (
        f"Authorization: Bearer {refusal.token}",
        f"Content-Type: {MULTIPART}",
        f"Content-Length: {refusal.size}",
    )
    with connect(refusing.server.url) as connection:
        connection.sendall(head(API, lines))
        for _ in range(10):
            time.sleep(0.1)
            connection.sendall(bytes(refusal.size // 10))
        assert answer_of(connection).status == refusal.status
