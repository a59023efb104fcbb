"""Files of ``deploy/`` and the operator's page name what exists, and ``nginx.conf`` protects a leaderboard."""

from __future__ import annotations

import itertools
import os
import re
import shlex
import socket
import ssl
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass
from email.message import Message
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from ipaddress import ip_address, ip_network
from pathlib import Path
from typing import Any

import httpx2
import pytest
import yaml

from leaderboard.settings import Settings, read_settings
from tests import requirements
from tests.leaderboard.serving import (
    API,
    RunServer,
    Server,
    bearer,
    free_port,
    read_response,
    run,
)
from tests.processes import wait_until

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "deploy"
CONTAINERFILE, NGINX_CONF = (DEPLOY / "Containerfile").read_text(), (DEPLOY / "nginx.conf").read_text()
HOST = "leaderboard.example.org"
PREFIX = "REBAR_LEADERBOARD_"


@pytest.fixture(scope="module")
def compose() -> dict[str, Any]:
    return dict(yaml.safe_load((DEPLOY / "compose.yaml").read_text()))


def parses(words: list[str]) -> bool:
    """Return whether ``rebar-leaderboard`` knows all words: an unknown option after them is the only error."""
    error = run(*words, "--nothing-such").stderr
    return "unrecognized arguments: --nothing-such\n" in error


@pytest.mark.parametrize("name", ["web", "scorer"])
def test_services_of_compose_have_valid_commands_and_settings(
    compose: dict[str, Any], name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = compose["services"][name]
    lines = re.findall(r"^ENV (.+)$", CONTAINERFILE, re.MULTILINE)
    image = dict(pair.split("=", 1) for line in lines for pair in shlex.split(line))
    for variable, value in {**image, **service["environment"]}.items():
        chosen = value.replace("${POSTGRES_PASSWORD}", "a-password")
        monkeypatch.setenv(variable, re.sub(r"\$\{PUBLIC_URL:\?[^}]+\}", f"https://{HOST}", chosen))
    settings = read_settings(None, {})
    assert parses(service["command"])
    assert service["command"] == (["serve", "--workers", "0"] if name == "web" else ["score"])
    assert settings.database_url == "postgresql+psycopg://board:a-password@database/board"
    assert settings.public_url == f"https://{HOST}", "without it, the addresses that the proxy states are ignored"
    assert settings.host == "0.0.0.0", "a container that listens to itself alone serves nobody"
    mounted = {volume.removesuffix(":ro").rsplit(":", 1)[1] for volume in service["volumes"]}
    assert mounted == {str(settings.state_dir), settings.data}
    assert (DEPLOY / service["build"]["context"]).resolve() == ROOT
    assert (ROOT / service["build"]["dockerfile"]).read_text() == CONTAINERFILE


def test_clients_reach_the_proxy_of_compose_alone_which_states_their_addresses(compose: dict[str, Any]) -> None:
    services, (network,) = compose["services"], compose["networks"]
    ports = {name: service["ports"] for name, service in services.items() if "ports" in service}
    assert ports == {"proxy": ["80:80", "443:443"]}
    proxy, web = (services[name]["networks"][network]["ipv4_address"] for name in ("proxy", "web"))
    assert services["web"]["environment"]["FORWARDED_ALLOW_IPS"] == proxy
    port = Settings.model_fields["port"].default
    assert f"upstream leaderboard {{ server {web}:{port}; }}" in (DEPLOY / "upstream-compose.conf").read_text()
    subnets = [ip_network(one["subnet"]) for one in compose["networks"][network]["ipam"]["config"]]
    assert {subnet.version for subnet in subnets} == {4, 6}
    assert compose["networks"][network]["enable_ipv6"] is True
    assert {ip_address(proxy), ip_address(web)} <= set(subnets[0].hosts())


def test_systemd_units_run_commands_that_exist(monkeypatch: pytest.MonkeyPatch) -> None:
    text = "".join(file.read_text() for file in sorted(DEPLOY.glob("*.service")))
    for name, value in re.findall(rf"^Environment=({PREFIX}\w+)=(.+)$", text, re.MULTILINE):
        monkeypatch.setenv(name, value)
    lines = re.findall(r"^ExecStart=/opt/leaderboard/bin/rebar-leaderboard (.+)$", text, re.MULTILINE)
    commands = [shlex.split(line) for line in lines]
    assert [words[0] for words in commands] == ["backup", "check", "serve"]
    assert all(map(parses, commands))
    assert f"ReadWritePaths={read_settings(None, {}).state_dir} {commands[0][-1]}" in text


HEAD_S, BODY_S = 2, 3
"""Time limits of ``nginx.conf`` in these tests, which are shorter than in the file."""
MAX_UPLOAD = 2_000_000
READS, WRITES = 100, 20
"""Requests of one address that ``nginx.conf`` lets through at once."""


@dataclass(frozen=True)
class Proxy:
    """Running nginx with ``deploy/nginx.conf``, its ports and its folder, and TLS that trusts its certificate."""

    http: int
    https: int
    folder: Path
    tls: ssl.SSLContext

    def client(self, source: str = "127.0.0.1") -> httpx2.Client:
        """Return a client whose connections come from an address of this machine."""
        transport = httpx2.HTTPTransport(verify=self.tls, local_address=source)
        base_url, headers = f"https://127.0.0.1:{self.https}", {"Host": HOST}
        return httpx2.Client(base_url=base_url, headers=headers, transport=transport, timeout=60)

    def connect(self, source: str = "127.0.0.1") -> ssl.SSLSocket:
        """Return a connection on which a test sends what it likes."""
        connection = socket.create_connection(("127.0.0.1", self.https), timeout=30, source_address=(source, 0))
        return self.tls.wrap_socket(connection, server_hostname=HOST)


RunNginx = Callable[[str], AbstractContextManager[Proxy]]


def nginx_configuration(folder: Path, address: str, ports: tuple[int, int]) -> str:
    """Return a whole configuration around ``deploy/nginx.conf``, with other addresses, files and time limits.

    Requests from 127.0.0.9 may state another address in the header ``Test-Address``.
    """
    text = (DEPLOY / "upstream.conf").read_text() + NGINX_CONF
    for found, replacement in (
        ("server 127.0.0.1:8000;", f"server {address};"),
        ("listen 80;", f"listen 127.0.0.1:{ports[0]};"),
        ("listen 443 ssl;", f"listen 127.0.0.1:{ports[1]} ssl;"),
        ("listen [::]:80;", ""),  # Not every machine that runs these tests has IPv6.
        ("listen [::]:443 ssl;", ""),
        (f"/etc/letsencrypt/live/{HOST}/", f"{folder}/"),
        ("/var/log/nginx/", f"{folder}/"),
        ("/var/www/html", str(folder)),
        ("client_header_timeout 15s;", f"client_header_timeout {HEAD_S}s;"),
        ("client_body_timeout 30s;", f"client_body_timeout {BODY_S}s;"),
    ):
        assert found in text, found
        text = text.replace(found, replacement)
    paths = ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    temporary = "".join(f"{name}_temp_path {folder}/{name};\n" for name in paths)
    user = "user root;\n" if os.geteuid() == 0 else ""  # Others may not write to the folder of a test.
    stated = "set_real_ip_from 127.0.0.9;\nreal_ip_header Test-Address;\n"
    return f"daemon off;\n{user}pid {folder}/pid;\nevents {{}}\nhttp {{\n{temporary}{stated}{text}\n}}\n"


@pytest.fixture(scope="module")
def running_nginx(tmp_path_factory: pytest.TempPathFactory) -> RunNginx:
    """Run nginx with ``deploy/nginx.conf`` before the server at an address until a block ends."""
    requirements.require("proxy")
    program = requirements.program_path("nginx")
    assert program is not None

    @contextmanager
    def run(address: str) -> Iterator[Proxy]:
        folder = tmp_path_factory.mktemp("nginx")
        names = f"-subj /CN={HOST} -addext subjectAltName=DNS:{HOST},IP:127.0.0.1"
        files = "-keyout privkey.pem -out fullchain.pem"
        command = f"openssl req -x509 -newkey rsa:2048 -nodes -days 2 {names} {files}".split()
        subprocess.run(command, check=True, capture_output=True, cwd=folder)
        ports = free_port(), free_port()
        (folder / "nginx.conf").write_text(nginx_configuration(folder, address, ports))
        errors = folder / "error.log"
        process = subprocess.Popen([program, "-e", str(errors), "-c", str(folder / "nginx.conf")])

        def is_running() -> bool:
            assert process.poll() is None, errors.read_text()
            return (folder / "pid").is_file() and bool((folder / "pid").read_text())

        try:
            wait_until(is_running, "nginx runs")
            yield Proxy(*ports, folder, ssl.create_default_context(cafile=str(folder / "fullchain.pem")))
        finally:
            process.terminate()
            process.wait(20)

    return run


@pytest.fixture(scope="module")
def server(running_server: RunServer) -> Iterator[Server]:
    """Run a leaderboard with the public address of ``nginx.conf``."""
    with running_server(public_url=f"https://{HOST}", max_upload=MAX_UPLOAD) as started:
        yield started
        assert not any("Traceback" in line for line in started.log)


@pytest.fixture(scope="module")
def proxy(running_nginx: RunNginx, server: Server) -> Iterator[Proxy]:
    """Run nginx before the leaderboard."""
    with running_nginx(server.url.removeprefix("http://")) as started:
        yield started


def request_head(method: str, path: str, *headers: str) -> bytes:
    return "\r\n".join((f"{method} {path} HTTP/1.1", f"Host: {HOST}", *headers, "", "")).encode()


def test_upload_through_the_proxy_is_scored(proxy: Proxy, server: Server, small_archive: Path) -> None:
    with proxy.client() as client:
        response = client.put(API, content=small_archive.read_bytes(), headers=bearer(server.token("alice")))
        assert response.status_code == 202, response.text
        submission_id = response.json()["id"]
        assert response.json()["url"] == f"https://{HOST}/submissions/{submission_id}"
        assert server.wait_until_ended(submission_id)["status"] == "scored"
        page = client.get(f"/submissions/{submission_id}", headers={"Accept": "text/html"})
    assert page.status_code == 200
    assert "small" in page.text
    assert page.headers["content-encoding"] == "gzip"
    log = (proxy.folder / "access.log").read_text()
    assert re.search(r"^127\.0\.0\.1 \[\S+\] PUT 202 ", log, re.MULTILINE)
    assert submission_id not in log, "the address of an unpublished submission gives access to it"


def test_plain_http_is_redirected_except_for_challenges(proxy: Proxy) -> None:
    (proxy.folder / ".well-known/acme-challenge").mkdir(parents=True)
    (proxy.folder / ".well-known/acme-challenge/name").write_text("answer")
    url, headers = f"http://127.0.0.1:{proxy.http}", {"Host": HOST}
    response = httpx2.get(f"{url}/compare?a=1", headers=headers)
    assert (response.status_code, response.headers["location"]) == (301, f"https://{HOST}/compare?a=1")
    assert httpx2.get(f"{url}/.well-known/acme-challenge/name", headers=headers).text == "answer"


@pytest.mark.parametrize(
    ("status", "headers"),
    [
        (401, ("Authorization: Bearer wrong", "Content-Length: 1000000000")),
        (413, ("Authorization: Bearer {token}", "Transfer-Encoding: chunked")),
        (413, ("Authorization: Bearer {token}", "Content-Length: 20000000000")),
    ],
    ids=["without token", "large in chunks", "too large for nginx"],
)
def test_client_that_is_still_sending_reads_why_it_is_refused(
    status: int, headers: tuple[str, ...], proxy: Proxy, server: Server
) -> None:
    """The client reads only after 16 MB, which no buffer holds. An answer would be lost by chance: five tries."""
    token = server.token(f"refused {headers}"[:100])
    piece = bytes(1 << 16)
    if "Transfer-Encoding: chunked" in headers:
        piece = b"%x\r\n%s\r\n" % (len(piece), piece)
    for attempt in range(5):
        with proxy.connect(f"127.0.5.{attempt + 1}") as connection:
            connection.sendall(request_head("PUT", API, *(line.format(token=token) for line in headers)))
            for _ in range(256):
                connection.sendall(piece)
            connection.settimeout(20)
            answer = connection.recv(1 << 16).decode()
        assert answer.startswith(f"HTTP/1.1 {status} "), answer[:2000]
    assert server.spool_files() == []


@pytest.mark.parametrize(("method", "burst", "other"), [("GET", READS, "POST"), ("POST", WRITES, "GET")])
def test_flood_of_one_address_is_refused(proxy: Proxy, method: str, burst: int, other: str) -> None:
    with proxy.client(f"127.0.1.{burst}") as client:
        responses = [client.request(method, "/api/v1/token") for _ in range(burst + 1)]
        while responses[-1].status_code != 429:
            assert len(responses) < 20 * READS
            responses.append(client.request(method, "/api/v1/token"))
    assert {response.status_code for response in responses[:burst]} <= {401, 405}
    assert "too many requests" in responses[-1].json()["detail"]
    assert responses[-1].headers["retry-after"] == "60"
    for source, allowed in ((f"127.0.1.{burst}", other), ("127.0.2.1", method)):
        with proxy.client(source) as client:
            assert client.request(allowed, "/api/v1/token").status_code in (401, 405), source


def test_addresses_of_one_ipv6_network_are_one_client(proxy: Proxy) -> None:
    """Every request has another address of the network."""
    with proxy.client("127.0.0.9") as client:

        def status(address: str) -> int:
            return int(client.get("/api/v1/token", headers={"Test-Address": address}).status_code)

        for number in itertools.count():
            if status(f"2001:db8:0:5::{number:x}") == 429:
                break
            assert number < 20 * READS
        assert status("2001:db8:0:6::1") == 401
        assert status("2001:db8::1") == 401


def test_connections_of_one_address_are_limited(proxy: Proxy) -> None:
    with ExitStack() as stack:
        for _ in range(50):
            connection = stack.enter_context(proxy.connect("127.0.3.1"))
            connection.sendall(request_head("GET", "/", "Content-Length: 9") + b"unfinished"[:5])
        statuses = []
        for source in ("127.0.3.1", "127.0.3.2"):
            with proxy.client(source) as client:
                statuses.append(client.get("/api/v1/token").status_code)
        assert statuses == [429, 401]


def test_slow_head_is_ended(proxy: Proxy) -> None:
    with proxy.connect() as connection:
        start = time.monotonic()
        connection.sendall(b"GET / HTTP/1.1\r\n")
        with suppress(OSError):
            while time.monotonic() - start < 20 * HEAD_S:
                connection.sendall(b"x")
                time.sleep(0.1)
        assert HEAD_S - 1 < time.monotonic() - start < 10 * HEAD_S


def test_stalled_upload_is_ended_and_leaves_no_file(proxy: Proxy, server: Server) -> None:
    authorization = f"Authorization: Bearer {server.token('slow')}"
    with proxy.connect() as connection:
        connection.sendall(request_head("PUT", API, authorization, "Content-Length: 1000000") + bytes(1000))
        wait_until(lambda: len(server.spool_files()) == 1, "the upload is received while it is sent", 20)
        start = time.monotonic()
        assert read_response(connection).status in (None, 408)
        assert time.monotonic() - start < 10 * BODY_S
        wait_until(lambda: server.spool_files() == [], "the file is deleted", 20)


HANDSHAKE = (
    "Connection: Upgrade",
    "Upgrade: websocket",
    "Sec-WebSocket-Version: 13",
    "Sec-WebSocket-Key: " + "A" * 24,
)


class _Recorder(BaseHTTPRequestHandler):
    """Web server in place of the leaderboard, which stores the headers of requests."""

    received: list[Message]

    def do_GET(self) -> None:
        type(self).received.append(self.headers)
        self.send_response(204)
        self.end_headers()

    def log_message(self, *_: object) -> None:
        pass


def test_leaderboard_gets_the_address_of_the_client_and_no_upgrade(running_nginx: RunNginx) -> None:
    _Recorder.received = []
    with ThreadingHTTPServer(("127.0.0.1", 0), _Recorder) as recorder:
        threading.Thread(target=recorder.serve_forever, daemon=True).start()
        with running_nginx(f"127.0.0.1:{recorder.server_port}") as proxy, proxy.client("127.0.0.2") as client:
            spoofed = {"X-Forwarded-For": "10.0.0.1", "X-Forwarded-Proto": "http"}
            headers = {**spoofed, **dict(line.split(": ") for line in HANDSHAKE)}
            assert client.get("/", headers=headers).status_code == 204
        recorder.shutdown()
    (received,) = _Recorder.received
    expected = {"Host": HOST, "X-Forwarded-For": "127.0.0.2", "X-Forwarded-Proto": "https"}
    assert {name: received.get_all(name) for name in expected} == {name: [expected[name]] for name in expected}
    assert received.get_all("Upgrade") is None
    assert received.get_all("Connection") is None


def test_refusals_of_nginx_itself_are_those_of_the_api(running_nginx: RunNginx) -> None:
    with running_nginx(f"127.0.0.1:{free_port()}") as proxy, proxy.client() as client:
        down, large = client.get("/"), client.post("/account", content=bytes(2 << 20))
    assert (down.status_code, down.json()["detail"]) == (503, "the leaderboard does not answer; try again later")
    assert (large.status_code, large.json()["detail"]) == (413, "the body of the request is too large")
