"""Files of ``deploy/`` and the operator's page: what they name exists, and nginx serves a leaderboard."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import ssl
import subprocess
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx2
import pytest
import yaml

from leaderboard.settings import Settings, read_settings
from tests.leaderboard.serving import API, RunServer, Server, bearer, free_port, run
from tests.processes import wait_until

ROOT = Path(__file__).parents[2]
DEPLOY, OPERATOR = ROOT / "deploy", ROOT / "docs/leaderboard-operator.md"
CONTAINERFILE, NGINX_CONF = (DEPLOY / "Containerfile").read_text(), (DEPLOY / "nginx.conf").read_text()
PAGE = OPERATOR.read_text()
PREFIX = "REBAR_LEADERBOARD_"
NON_SETTINGS = {"name", "token"}
"""Names on the page that are not server settings: a placeholder and a variable of the client."""


@pytest.fixture(scope="module")
def compose() -> dict[str, Any]:
    return dict(yaml.safe_load((DEPLOY / "compose.yaml").read_text()))


def instructions(name: str) -> list[str]:
    """Return the arguments of every instruction ``name`` in the Containerfile."""
    return re.findall(rf"^{name} (.+)$", CONTAINERFILE, re.MULTILINE)


def parses(words: list[str]) -> bool:
    """Return whether ``rebar-leaderboard`` knows all words: an unknown option after them is the only error."""
    error = run(*words, "--nothing-such").stderr
    return "unrecognized arguments: --nothing-such\n" in error


def test_settings_that_are_set_exist() -> None:
    for file in [*sorted(DEPLOY.iterdir()), OPERATOR]:
        names = {name.lower() for name in re.findall(rf"{PREFIX}(\w+)", file.read_text())}
        assert names or file.suffix in (".conf", ".timer"), f"{file.name}: nothing is set"
        allowed = NON_SETTINGS if file.suffix == ".md" else set()
        assert names <= set(Settings.model_fields) | allowed, file.name


def test_commands_of_the_page_parse() -> None:
    blocks = re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)
    lines = [shlex.split(line, comments=True) for block in blocks for line in block.splitlines()]
    commands = [words[1:] for words in lines if words and words[0] == "rebar-leaderboard"]
    assert all(map(parses, commands)), commands
    known = re.findall(r"^    ([a-z]+)", run("--help").stdout, re.MULTILINE)
    assert {words[0] for words in commands} == set(known)


def test_extras_and_files_that_are_installed_exist() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lists = re.findall(r"pip install \'\.\[([\w,]+)\]", PAGE) + re.findall(r"/source\[([\w,]+)\]", CONTAINERFILE)
    extras = {extra for one in lists for extra in one.split(",")}
    assert {"server", "postgresql"} <= extras <= set(project["optional-dependencies"])
    (constraints,) = re.findall(r"--constraint /source/(\S+)", CONTAINERFILE)
    assert (ROOT / constraints).is_file()
    (entry,) = instructions("ENTRYPOINT")
    assert json.loads(entry)[0] in project["scripts"]
    (unit,) = DEPLOY.glob("*.timer")
    assert unit.with_suffix(".service").is_file()


@pytest.mark.parametrize("name", ["web", "scorer"])
def test_services_of_compose_have_valid_commands_and_settings(
    compose: dict[str, Any], name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = compose["services"][name]
    image = dict(pair.split("=", 1) for line in instructions("ENV") for pair in shlex.split(line))
    for variable, value in {**image, **service["environment"]}.items():
        monkeypatch.setenv(variable, str(value).replace("${POSTGRES_PASSWORD}", "a-password"))
    settings = read_settings(None, {})
    assert parses(service["command"])
    assert service["command"] == (["serve", "--workers", "0"] if name == "web" else ["score"])
    assert settings.database_url == "postgresql+psycopg://board:a-password@database/board"
    assert settings.host == "0.0.0.0", "a container that listens to itself alone serves nobody"
    mounted = {volume.removesuffix(":ro").rsplit(":", 1)[1] for volume in service["volumes"]}
    assert mounted == {str(settings.state_dir), settings.data}
    assert (DEPLOY / service["build"]["context"]).resolve() == ROOT
    assert (ROOT / service["build"]["dockerfile"]).read_text() == CONTAINERFILE


def test_names_in_compose_and_containerfile_agree(compose: dict[str, Any]) -> None:
    services, port = compose["services"], str(Settings.model_fields["port"].default)
    assert (services["web"]["ports"], services["scorer"]["ports"]) == ([f"127.0.0.1:{port}:{port}"], [])
    assert instructions("EXPOSE") == [port]
    assert f"127.0.0.1:{port}/healthz" in CONTAINERFILE
    used = {volume.split(":")[0] for service in services.values() for volume in service["volumes"]}
    assert set(compose["volumes"]) == {name for name in used if name.isidentifier()}
    assert {services["database"]["environment"][f"POSTGRES_{name}"] for name in ("USER", "DB")} == {"board"}
    assert parses(json.loads(instructions("CMD")[0]))
    images = [service["image"] for service in services.values() if "image" in service] + instructions("FROM")
    assert all(re.fullmatch(r"[a-z0-9-]+:[\w.-]+", image) for image in images), "a registry, or no tag"


def test_systemd_units_run_commands_that_exist(monkeypatch: pytest.MonkeyPatch) -> None:
    text = "".join(file.read_text() for file in sorted(DEPLOY.glob("*.service")))
    for name, value in re.findall(rf"^Environment=({PREFIX}\w+)=(.+)$", text, re.MULTILINE):
        monkeypatch.setenv(name, value)
    lines = re.findall(r"^ExecStart=/opt/leaderboard/bin/rebar-leaderboard (.+)$", text, re.MULTILINE)
    commands = [shlex.split(line) for line in lines]
    assert [words[0] for words in commands] == ["backup", "check", "serve"]
    assert all(map(parses, commands))
    assert f"ReadWritePaths={read_settings(None, {}).state_dir} {commands[0][-1]}" in text


def test_commands_in_comments_name_existing_files(compose: dict[str, Any]) -> None:
    comments = "".join(re.findall(r"^#.+\n", (DEPLOY / "compose.yaml").read_text() + CONTAINERFILE, re.MULTILINE))
    files = re.findall(r"-f (\S+)", comments)
    assert sorted(files) == ["deploy/Containerfile", "deploy/compose.yaml"]
    assert all((ROOT / file).is_file() for file in files)
    assert set(re.findall(r"--scale (\w+)=", comments)) <= set(compose["services"])


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
    text = NGINX_CONF
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
def proxied(tmp_path_factory: pytest.TempPathFactory, running_server: RunServer) -> Iterator[Proxied]:
    if not (NGINX.is_file() and shutil.which("openssl")):  # Not installed for tests: its package starts a service.
        pytest.skip("nginx or openssl is not installed")
    folder = tmp_path_factory.mktemp("nginx")
    ports = {name: free_port() for name in ("http", "https")}
    command = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", f"/CN={HOST}"]
    command += ["-addext", f"subjectAltName=DNS:{HOST}"]
    command += ["-keyout", str(folder / "key.pem"), "-out", str(folder / "cert.pem")]
    subprocess.run(command, check=True, capture_output=True)
    settings = {"public_url": f"https://{HOST}", "max_connections_per_address": 0, "quota": 3}
    with running_server(folder / "state", read_rate_limit=f"{READS}/hour", **settings) as server:
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


def test_submission_through_the_proxy_is_scored(proxied: Proxied, small_archive: Path) -> None:
    content, token = small_archive.read_bytes(), proxied.server.token("alice")
    extensions = {"sni_hostname": HOST}
    response = proxied.client.put(API, content=content, headers=bearer(token), extensions=extensions)
    assert response.status_code == 202, response.text
    assert response.json()["url"] == f"https://{HOST}/submissions/{response.json()['id']}"
    assert proxied.server.wait_until_ended(response.json()["id"])["status"] == "scored"
    page = get(proxied, "/", Accept="text/html")
    assert page.status_code == 200
    assert "small" in page.text
    assert page.headers["content-encoding"] == "gzip"


def test_rate_limit_counts_the_address_that_the_proxy_reports(proxied: Proxied) -> None:
    statuses = {
        get(proxied, "/openapi.json", **{"X-Forwarded-For": f"10.0.0.{k}"}).status_code for k in range(READS)
    }
    assert statuses == {200, 429}, "addresses that a client states are replaced by the proxy"


def test_plain_http_is_redirected_in_the_configuration() -> None:
    assert re.search(r"return 301 https://\$host\$request_uri;", NGINX_CONF)
