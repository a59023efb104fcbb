"""Consistency of ``deploy/`` and the leaderboard's pages with the code: settings, commands, requests, images."""

from __future__ import annotations

import json
import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml
from fastapi.routing import APIRoute

from leaderboard.cli import COMMANDS, argument_parser
from leaderboard.settings import Settings, read_settings
from leaderboard.web.api import leaderboard, status, submissions

ROOT = Path(__file__).parents[2]
DATA_VOLUME = "${DATASET:?set the dataset folder}:/data:ro"
COMPOSE, CONTAINERFILE = ROOT / "deploy/compose.yaml", ROOT / "deploy/Containerfile"
API_ROUTERS = (leaderboard.router, status.router, submissions.router)
SUBMITTERS = ROOT / "docs/leaderboard-submitter.md"
OPERATOR = ROOT / "docs/leaderboard-operator.md"
PAGE = OPERATOR.read_text()
PREFIX = "REBAR_LEADERBOARD_"
NON_SETTINGS = {"name", "token"}
"""Names on the page that are not server settings: a placeholder and a variable of the client."""


@pytest.fixture(scope="module")
def compose() -> dict[str, Any]:
    return dict(yaml.safe_load(COMPOSE.read_text()))


def instructions(name: str) -> list[str]:
    """Return the arguments of every instruction ``name`` in the Containerfile."""
    return re.findall(rf"^{name} (.+)$", CONTAINERFILE.read_text(), re.MULTILINE)


def environment_of(service: dict[str, Any]) -> dict[str, str]:
    return {name: str(value) for name, value in service.get("environment", {}).items()}


def image_environment() -> dict[str, str]:
    return dict(pair.split("=", 1) for line in instructions("ENV") for pair in shlex.split(line))


def test_deployed_settings_exist() -> None:
    for file in [*sorted((ROOT / "deploy").iterdir()), OPERATOR]:
        names = {name.lower() for name in re.findall(rf"{PREFIX}(\w+)", file.read_text())}
        assert names or file.suffix in (".conf", ".timer"), f"{file.name}: nothing is set"
        allowed = NON_SETTINGS if file.suffix == ".md" else set()
        assert names <= set(Settings.model_fields) | allowed, file.name


def shell_lines(program: str) -> list[list[str]]:
    """Return the argument lists of the commands of ``program`` on the page."""
    blocks = re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)
    lines = [shlex.split(line, comments=True) for block in blocks for line in block.splitlines()]
    return [words[1:] for words in lines if words and words[0] == program]


def test_page_commands_parse() -> None:
    commands = [argument_parser().parse_args(words).command for words in shell_lines("rebar-leaderboard")]
    assert set(commands) == set(COMMANDS)


def test_page_settings_table_matches_code() -> None:
    table_rows = re.findall(r"^\| `(\w+)` \| (?:`(.*)`)? ?\| (.+) \|$", PAGE, re.MULTILINE)
    fields = Settings.model_fields.items()
    expected = [
        (name, "" if field.is_required() else str(field.default), field.description) for name, field in fields
    ]
    assert table_rows == expected


def test_extras_on_page_exist() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    installed = {
        extra
        for extras_list in re.findall(r"pip install \'\.\[([\w,]+)\]", PAGE)
        for extra in extras_list.split(",")
    }
    assert {"server", "postgresql"} <= installed <= set(extras)


@pytest.mark.parametrize("service", ["web", "scorer"])
def test_compose_services_have_valid_settings(
    compose: dict[str, Any], service: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    environment = {**image_environment(), **environment_of(compose["services"][service])}
    for name, value in environment.items():
        monkeypatch.setenv(name, value.replace("${POSTGRES_PASSWORD}", "a-password"))
    options = argument_parser().parse_args(compose["services"][service]["command"])
    settings = read_settings(None, {})
    assert options.command in ("serve", "score")
    assert settings.database_url == "postgresql+psycopg://board:a-password@database/board"
    assert settings.data == "/data"
    assert settings.host == "0.0.0.0", "a container that listens to itself alone serves nobody"
    assert settings.state_dir == Path("/state")


def test_web_service_has_no_workers(compose: dict[str, Any]) -> None:
    options = argument_parser().parse_args(compose["services"]["web"]["command"])
    assert (options.command, options.workers) == ("serve", "0")
    assert compose["services"]["scorer"]["command"] == ["score"]


def test_ports_volumes_and_database_are_consistent(compose: dict[str, Any]) -> None:
    services = compose["services"]
    port = str(Settings.model_fields["port"].default)
    assert services["web"]["ports"] == [f"127.0.0.1:{port}:{port}"]
    assert instructions("EXPOSE") == [port]
    assert f"127.0.0.1:{port}/healthz" in CONTAINERFILE.read_text()
    assert services["scorer"]["ports"] == [], "scorers beside the web server cannot have its port"
    for name in ("web", "scorer"):
        mounted = {volume.removesuffix(":ro").rsplit(":", 1)[1] for volume in services[name]["volumes"]}
        assert mounted == {"/state", "/data"}
        assert [volume for volume in services[name]["volumes"] if volume.endswith(":ro")] == [DATA_VOLUME]
    declared = set(compose["volumes"])
    used = {volume.split(":")[0] for service in services.values() for volume in service["volumes"]}
    assert declared == {name for name in used if name.isidentifier()}
    assert services["database"]["environment"]["POSTGRES_USER"] == "board"
    assert services["database"]["environment"]["POSTGRES_DB"] == "board"


def test_systemd_units_run_commands_that_exist(monkeypatch: pytest.MonkeyPatch) -> None:
    text = "".join(file.read_text() for file in sorted((ROOT / "deploy").glob("*.service")))
    for name, value in re.findall(rf"^Environment=({PREFIX}\w+)=(.+)$", text, re.MULTILINE):
        monkeypatch.setenv(name, value)
    settings = read_settings(None, {})
    commands = re.findall(r"^ExecStart=/opt/leaderboard/bin/rebar-leaderboard (.+)$", text, re.MULTILINE)
    options = [argument_parser().parse_args(shlex.split(command)) for command in commands]
    assert [one.command for one in options] == ["backup", "check", "serve"]
    assert f"ReadWritePaths={settings.state_dir} {options[0].target}" in text
    (unit,) = (ROOT / "deploy").glob("*.timer")
    assert unit.with_suffix(".service").is_file()


def test_images_have_no_registry(compose: dict[str, Any]) -> None:
    images = [service["image"] for service in compose["services"].values() if "image" in service]
    images += instructions("FROM")
    assert len(images) == 2
    for image in images:
        name, _, tag = image.partition(":")
        assert re.fullmatch(r"[a-z0-9-]+", name), f"{image}: expected a plain name"
        assert re.fullmatch(r"[\w.-]+", tag), f"{image}: expected a tag"


def test_containerfile_refers_to_existing_files(compose: dict[str, Any]) -> None:
    build = compose["services"]["web"]["build"]
    assert (COMPOSE.parent / build["context"]).resolve() == ROOT
    assert ROOT / build["dockerfile"] == CONTAINERFILE
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    (extras,) = re.findall(r"/source\[([\w,]+)\]", CONTAINERFILE.read_text())
    assert set(extras.split(",")) <= set(project["optional-dependencies"])
    (constraints,) = re.findall(r"--constraint /source/(\S+)", CONTAINERFILE.read_text())
    assert (ROOT / constraints).is_file()
    (entry,) = instructions("ENTRYPOINT")
    assert json.loads(entry)[0] in project["scripts"]
    (command,) = instructions("CMD")
    assert argument_parser().parse_args(json.loads(command)).command == "serve"


def test_commands_in_comments_refer_to_existing_files() -> None:
    commands = re.findall(r"^#   (.+)$", COMPOSE.read_text() + CONTAINERFILE.read_text(), re.MULTILINE)
    files = [file for command in commands for file in re.findall(r"-f (\S+)", command)]
    assert sorted(files) == ["deploy/Containerfile", "deploy/compose.yaml"]
    assert all((ROOT / file).is_file() for file in files)
    (scaled,) = re.findall(r"--scale (\w+)=", " ".join(commands))
    assert scaled in yaml.safe_load(COMPOSE.read_text())["services"]


def test_submitters_page_lists_every_request() -> None:
    routes = [route for router in API_ROUTERS for route in router.routes if isinstance(route, APIRoute)]
    served = {
        f"{method} {re.sub(r'{[^}]+}', 'ID', route.path)}"
        for route in routes
        if route.include_in_schema
        for method in route.methods or ()
    }
    listed = re.findall(r"^\| `([A-Z]+ [^`?]+)", SUBMITTERS.read_text(), re.MULTILINE)
    assert {*listed, "GET /api/v1/leaderboard.csv"} == served
    assert "`leaderboard.csv`" in SUBMITTERS.read_text()
