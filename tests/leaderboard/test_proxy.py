"""The reverse proxy of ``deploy/nginx.conf`` with TLS: addresses, uploads and limits through a real nginx."""

from __future__ import annotations

import re
import shutil
import ssl
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx2
import pytest

from tests.leaderboard.conftest import WriteArchive
from tests.leaderboard.serving import RunServer, Server, free_port
from tests.processes import wait_until

CONFIGURATION = Path(__file__).parents[2] / "deploy" / "nginx.conf"
NGINX = Path("/usr/sbin/nginx")
HOST = "leaderboard.example.org"
READS = 40


@dataclass(frozen=True)
class Proxied:
    """A leaderboard behind nginx: the server, and a client that trusts the certificate."""

    server: Server
    client: httpx2.Client


def nginx_configuration(folder: Path, backend: str, ports: dict[str, int]) -> str:
    """Return a whole configuration around ``deploy/nginx.conf``, with other ports and files."""
    text = CONFIGURATION.read_text()
    for found, replacement in (
        ("listen 80;", f"listen 127.0.0.1:{ports['http']};"),
        ("listen 443 ssl;", f"listen 127.0.0.1:{ports['https']} ssl;"),
        ("/etc/ssl/certs/leaderboard.pem", str(folder / "cert.pem")),
        ("/etc/ssl/private/leaderboard.key", str(folder / "key.pem")),
        ("http://127.0.0.1:8000", backend),
    ):
        assert found in text, found
        text = text.replace(found, replacement)
    paths = ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    temporary = "".join(f"{name}_temp_path {folder}/{name};\n" for name in paths)
    return f"daemon off;\npid {folder}/pid;\nevents {{}}\nhttp {{\naccess_log off;\n{temporary}{text}\n}}\n"


@pytest.fixture(scope="module")
def proxied(
    tiny_root: Path, tmp_path_factory: pytest.TempPathFactory, running_server: RunServer
) -> Iterator[Proxied]:
    if not (NGINX.is_file() and shutil.which("openssl")):  # Not installed for tests: its package starts a service.
        pytest.skip("nginx or openssl is not installed")
    folder = tmp_path_factory.mktemp("nginx")
    ports = {name: free_port() for name in ("http", "https")}
    command = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", f"/CN={HOST}"]
    command += ["-addext", f"subjectAltName=DNS:{HOST}"]
    command += ["-keyout", str(folder / "key.pem"), "-out", str(folder / "cert.pem")]
    subprocess.run(command, check=True, capture_output=True)
    settings = {"public_url": f"https://{HOST}", "max_connections_per_address": 0}
    with running_server(
        tiny_root, folder / "state", **settings, read_rate_limit=f"{READS}/hour", quota=3
    ) as server:
        (folder / "nginx.conf").write_text(nginx_configuration(folder, server.url, ports))
        with (folder / "log").open("w") as log:
            command = [str(NGINX), "-e", str(folder / "error.log"), "-c", str(folder / "nginx.conf")]
            process = subprocess.Popen(command, stderr=log)
        trusted = ssl.create_default_context(cafile=str(folder / "cert.pem"))
        base = f"https://127.0.0.1:{ports['https']}"
        client = httpx2.Client(base_url=base, verify=trusted, headers={"Host": HOST}, timeout=60)
        try:
            wait_until(lambda: (folder / "pid").is_file() and (folder / "pid").read_text(), "nginx runs")
            yield Proxied(server, client)
        finally:
            client.close()
            process.terminate()
            process.wait(20)


def get(proxied: Proxied, path: str, **headers: str) -> httpx2.Response:
    extensions = {"sni_hostname": HOST}
    return proxied.client.get(path, headers={"Host": HOST, **headers}, extensions=extensions)


def test_submission_through_the_proxy_is_scored(proxied: Proxied, write_archive: WriteArchive) -> None:
    token = proxied.server.token("alice")
    archive = write_archive("proxied", configs=("lattice-orbit",))
    response = proxied.client.put(
        "/api/v1/submissions",
        content=archive.read_bytes(),
        headers={"Authorization": f"Bearer {token}"},
        extensions={"sni_hostname": HOST},
    )
    assert response.status_code == 202, response.text
    assert response.json()["url"] == f"https://{HOST}/submissions/{response.json()['id']}"
    assert proxied.server.wait_until_ended(response.json()["id"])["status"] == "scored"
    page = get(proxied, "/", Accept="text/html")
    assert page.status_code == 200
    assert "proxied" in page.text
    assert page.headers["content-encoding"] == "gzip"


def test_rate_limit_counts_the_address_that_the_proxy_reports(proxied: Proxied) -> None:
    statuses = {
        get(proxied, "/openapi.json", **{"X-Forwarded-For": f"10.0.0.{k}"}).status_code for k in range(READS)
    }
    assert statuses == {200, 429}, "addresses that a client states are replaced by the proxy"


def test_plain_http_is_redirected_in_the_configuration() -> None:
    assert re.search(r"return 301 https://\$host\$request_uri;", CONFIGURATION.read_text())
