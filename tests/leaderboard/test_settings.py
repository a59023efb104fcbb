"""Settings: sources, precedence and validation messages."""

from __future__ import annotations

import re
import signal
import socket
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from pydantic import ByteSize

from leaderboard.settings import Settings, read_settings
from tests.leaderboard.boards import add_submission, assert_sound, board_settings, make_board
from tests.leaderboard.serving import run

PASSWORD = "Hunter2"
PREFIX = "REBAR_LEADERBOARD_"
FILES = {
    "unknown": b"quotta = 3",
    "list": f'db = ["postgresql://u:{PASSWORD}@h/x"]'.encode(),
    "long": f"quota = '{'many' * 200_000}'".encode(),
    "parameter": b"_env_file = '/dev/zero'",
    "malformed": b"port = = 1",
}


@dataclass(frozen=True)
class Case:
    """Command that must fail, and a pattern of its error message.

    ``DATA`` is replaced by a dataset folder, ``HERE`` by a folder with ``FILES``, ``TAKEN`` by a port in use.
    """

    words: str
    options: str
    command: str = "serve --data DATA --state-dir HERE/state --port 0"
    environment: Mapping[str, str] = field(default_factory=dict)


COMMAND_WITHOUT_DATA = "serve --state-dir HERE/state"
CASES = {
    "unknown key": Case("quotta: there is no such setting", "--settings HERE/unknown"),
    "parameter of the settings class": Case("_env_file: there is no such setting", "--settings HERE/parameter"),
    "long value": Case(r"quota: .{100,200}$", "--settings HERE/long"),
    "wrong type of a secret": Case("db: ", "--settings HERE/list"),
    "two at once": Case("port: .*quota: ", "--port x --quota -1"),
    "unknown variable": Case(
        "REBAR_LEADERBOARD_HIDDEN_TRUTH: there is no such setting", "", environment={f"{PREFIX}HIDDEN_TRUTH": "1"}
    ),
    "malformed TOML": Case("malformed: .*\n.*not a valid TOML file", "--settings HERE/malformed"),
    "no data": Case("data: is not given", f"--db postgresql://u:{PASSWORD}@h/x", COMMAND_WITHOUT_DATA),
    "dataset missing": Case("no such folder", "--data HERE/none", COMMAND_WITHOUT_DATA),
    "another database": Case("db: expected sqlite", f"--db mysql://u:{PASSWORD}@h/x"),
    "database's port": Case("db: expected sqlite", f"--db postgresql://u:{PASSWORD}@h:port/x"),
    "database in memory": Case("db: expected sqlite", "--db sqlite:///?mode=memory"),
    "database unavailable": Case("database is unavailable", f"--db postgresql://u:{PASSWORD}@127.0.0.1:1/x"),
    "state is a file": Case("the state folder .* cannot be written", "--state-dir HERE/list"),
    "port taken": Case("cannot listen on this address: Address already in use", "--port TAKEN"),
    "archives at a URL": Case("archives: expected a folder", "--archives s3://bucket/x"),
    "archives in a file": Case("the archive storage .* cannot be written", "--archives HERE/list/x"),
}


@pytest.fixture(scope="module")
def places(tiny_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """Yield what ``DATA``, ``HERE`` and ``TAKEN`` stand for."""
    folder = tmp_path_factory.mktemp("settings")
    for name, content in FILES.items():
        (folder / name).write_bytes(content)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        yield {"DATA": str(tiny_root), "HERE": str(folder), "TAKEN": str(taken.getsockname()[1])}


@pytest.fixture
def _time_limit() -> Iterator[None]:
    """Fail a command that serves instead of failing."""
    former = signal.signal(signal.SIGALRM, lambda *_: pytest.fail("the command did not fail within 60 s"))
    signal.alarm(60)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, former)


@pytest.mark.slow
@pytest.mark.usefixtures("_time_limit")
@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_invalid_settings_exit_2_with_message(
    case: Case, places: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in case.environment.items():
        monkeypatch.setenv(name, value)
    words = f"{case.command} {case.options}".split()
    process = run(*(re.sub("DATA|HERE|TAKEN", lambda match: places[match[0]], word) for word in words))
    assert process.returncode == 2, process.stderr
    lines = [line for line in process.stderr.splitlines() if not line.startswith("{")]
    assert lines[0].startswith("error: "), process.stderr
    assert sum(line.startswith("error:") for line in lines) == 1
    assert re.search(case.words, process.stderr), process.stderr
    assert "Traceback" not in process.stderr
    assert PASSWORD not in process.stderr


def test_precedence_is_command_line_file_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "board.toml"
    file.write_text('data = "from-file"\ntitle = "from file"\nquota = 7\n')
    monkeypatch.setenv(PREFIX + "TOKEN", "rdb_of_the_client")
    for name, value in (("TITLE", "from environment"), ("QUOTA", "8"), ("LEASE_SECONDS", "9")):
        monkeypatch.setenv(PREFIX + name, value)
    settings = read_settings(file, {"title": "from command line"})
    assert (settings.title, settings.quota, settings.lease_seconds) == ("from command line", 7, 9.0)
    assert (settings.data, settings.port) == ("from-file", Settings.model_fields["port"].default)
    assert read_settings(None, {"data": "x"}).title == "from environment"


def example_value(name: str) -> str:
    """Return a valid value of the setting that is not its default."""
    special = {
        "db": "sqlite:///elsewhere.sqlite",
        "default_visibility": "owner",
        "state_dir": "/elsewhere",
        "rescore": "true",
        **dict.fromkeys(("public_url", "dataset_url", "paper_url"), "https://example.org/board"),
    }
    kind = Settings.model_fields[name].annotation
    return special.get(name, "17" if kind in (int, float, ByteSize) else "something")


@pytest.mark.parametrize("name", Settings.model_fields)
def test_every_setting_is_read_from_every_source(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[Settings] = []
    monkeypatch.setattr("leaderboard.web.server.serve", started.append)
    rest: dict[str, Any] = {} if name == "data" else {"data": "x"}
    value = example_value(name).replace("/elsewhere", str(tmp_path / "elsewhere"))
    options = ("--data", "x", "--state-dir", tmp_path / "state", f"--{name.replace('_', '-')}", value)
    process = run("serve", *options)
    assert process.returncode == 0, process.stderr
    by_command = getattr(started[0], name)
    (tmp_path / "one.toml").write_text(f"{name} = {value if value.isdigit() else repr(value)}\n")
    assert getattr(read_settings(tmp_path / "one.toml", rest), name) == by_command
    monkeypatch.setenv(PREFIX + name.upper(), value)
    assert getattr(read_settings(None, rest), name) == by_command
    assert str(by_command).lower() in (value, f"{value}.0")
    assert Settings.model_fields[name].default != by_command


def test_state_folder_name_may_have_special_characters(tmp_path: Path) -> None:
    settings = board_settings(tmp_path / "a st%20ate?b")
    add_submission(settings, make_board(settings), b"zip")
    assert_sound(settings)
    assert (settings.state_dir / "leaderboard.sqlite").is_file()
