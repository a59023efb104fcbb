"""Settings: sources, precedence and validation messages."""

from __future__ import annotations

import re
import signal
import socket
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from pydantic import ByteSize

from leaderboard.settings import Settings, read_settings
from leaderboard.storage.archive_store import ArchiveStore
from rebar_depth_bench.base.errors import InputError
from tests.leaderboard.serving import run

PASSWORD = "Hunter2"
PREFIX = "REBAR_LEADERBOARD_"
FILES = {
    "unknown": b"quotta = 3",
    "secret": f'dbb = "postgresql://u:{PASSWORD}@h/x"'.encode(),
    "list": f'db = ["postgresql://u:{PASSWORD}@h/x"]'.encode(),
    "type": b'quota = "many"',
    "malformed": b"port = = 1",
    "parameter": b"_env_file = '/dev/zero'",
    "long": f"quota = '{'many' * 200_000}'".encode(),
    "escape": rb'"\u001b[2J" = 1',
    "latin": b'title = "\xe4"',
    "utf16": "quota = 3".encode("utf-16"),
    "bom": b"\xef\xbb\xbfquotta = 3",
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
    "unknown key after a byte order mark": Case("quotta: there is no such setting", "--settings HERE/bom"),
    "UTF-16": Case("the text is UTF-16", "--settings HERE/utf16"),
    "unknown key with a secret": Case("dbb: there is no such setting", "--settings HERE/secret"),
    "parameter of the settings class": Case("_env_file: there is no such setting", "--settings HERE/parameter"),
    "device as TOML file": Case("cannot be read: it is a device", "--settings /dev/zero"),
    "long value": Case(r"quota: .{100,200}$", "--settings HERE/long"),
    "escape sequence": Case(r"'\\x1b\[2J': there is no such setting", "--settings HERE/escape"),
    "wrong type": Case("quota: .*'many'", "--settings HERE/type"),
    "wrong type of a secret": Case("db: ", "--settings HERE/list"),
    "two at once": Case("port: .*quota: ", "--port x --quota -1"),
    "wrong type in the environment": Case(
        "lease_seconds: .*'soon'", "", environment={f"{PREFIX}LEASE_SECONDS": "soon"}
    ),
    "port too high": Case("port: .*65535.*65536", "--port 65536"),
    "neither owner nor always": Case("default_visibility: .*'owner' or 'always'", "--default-visibility never"),
    "unknown variable": Case(
        "REBAR_LEADERBOARD_HIDDEN_TRUTH: there is no such setting", "", environment={f"{PREFIX}HIDDEN_TRUTH": "1"}
    ),
    "malformed TOML": Case("malformed: .*\n.*not a valid TOML file", "--settings HERE/malformed"),
    "TOML that is not UTF-8": Case("latin: .*\n.*not UTF-8", "--settings HERE/latin"),
    "no TOML file": Case("none: .*\n.*cannot be read: No such file", "--settings HERE/none"),
    "folder as TOML file": Case("cannot be read: it is a folder", "--settings HERE"),
    "no data": Case("data: is not given", f"--db postgresql://u:{PASSWORD}@h/x", COMMAND_WITHOUT_DATA),
    "dataset missing": Case("no such folder", "--data HERE/none", COMMAND_WITHOUT_DATA),
    "dataset empty": Case("no manifest.json", "--data HERE", COMMAND_WITHOUT_DATA),
    "another database": Case("db: expected sqlite", f"--db mysql://u:{PASSWORD}@h/x"),
    "database's port": Case("db: expected sqlite", f"--db postgresql://u:{PASSWORD}@h:port/x"),
    "database unavailable": Case("database is unavailable", f"--db postgresql://u:{PASSWORD}@127.0.0.1:1/x"),
    "database unavailable, token": Case(
        "database is unavailable",
        f"--db postgresql://u:{PASSWORD}@127.0.0.1:1/x",
        "token me --state-dir HERE/state",
    ),
    "database unavailable, score": Case(
        "database is unavailable",
        f"--db postgresql://u:{PASSWORD}@127.0.0.1:1/x",
        "score --data DATA --state-dir HERE/state",
    ),
    "state is a file": Case("the state folder .* cannot be written", "--state-dir HERE/type"),
    "port taken": Case("cannot listen on this address: Address already in use", "--port TAKEN"),
    "not our address": Case("cannot listen on this address", "--host 192.0.2.1"),
    "no address at all": Case("cannot listen on this address", f"--host {'x' * 70}"),
    "archives at a URL": Case("archives: expected a folder", "--archives s3://bucket/x"),
    "archives in a file": Case("the archive storage .* cannot be written", "--archives HERE/type/x"),
    "backup of nothing": Case("database does not exist", "--state-dir HERE", "backup HERE/b"),
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


@pytest.fixture
def settings_file(tmp_path: Path) -> Path:
    (tmp_path / "board.toml").write_text('data = "from-file"\ntitle = "from file"\nquota = 7\n')
    return tmp_path / "board.toml"


def test_precedence_is_command_line_file_environment(settings_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PREFIX + "TOKEN", "rdb_of_the_client")
    for name, value in (("TITLE", "from environment"), ("QUOTA", "8"), ("LEASE_SECONDS", "9")):
        monkeypatch.setenv(PREFIX + name, value)
    settings = read_settings(settings_file, {"title": "from command line"})
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


@pytest.fixture
def served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Settings]:
    """Return the settings with which the command ``serve`` starts the server, which does not run here."""
    started: list[Settings] = []
    monkeypatch.setattr("leaderboard.web.server.serve", started.append)

    def serve(*options: str) -> Settings:
        process = run("serve", "--data", "x", "--state-dir", tmp_path / "state", *options)
        assert process.returncode == 0, process.stderr
        return started[-1]

    return serve


def test_switches_need_no_value(served: Callable[..., Settings]) -> None:
    assert served("--rescore").rescore is True


@pytest.mark.parametrize("name", Settings.model_fields)
def test_every_setting_is_read_from_every_source(
    name: str, served: Callable[..., Settings], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rest: dict[str, Any] = {} if name == "data" else {"data": "x"}
    value = example_value(name).replace("/elsewhere", str(tmp_path / "elsewhere"))
    by_command = getattr(served(f"--{name.replace('_', '-')}", value), name)
    (tmp_path / "one.toml").write_text(f"{name} = {value if value.isdigit() else repr(value)}\n")
    assert getattr(read_settings(tmp_path / "one.toml", rest), name) == by_command
    monkeypatch.setenv(PREFIX + name.upper(), value)
    assert getattr(read_settings(None, rest), name) == by_command
    assert str(by_command).lower() in (value, f"{value}.0")
    assert Settings.model_fields[name].default != by_command


def help_of(*command: str) -> str:
    """Return the help of a command on one line."""
    process = run(*command, "--help")
    assert process.returncode == 0
    return " ".join(process.stdout.split())


def test_help_shows_every_setting_with_its_default() -> None:
    shown = {command: help_of(command) for command in re.findall(r"^    ([a-z]+)", run("--help").stdout, re.M)}
    assert {"serve", "score", "token", "tokens", "submissions", "requeue", "check", "remove", "backup"} == set(
        shown
    )
    for name, field_info in Settings.model_fields.items():
        default, option = field_info.default, f"--{name.replace('_', '-')} "
        assert option in shown["serve"]
        for command, text in shown.items():
            if option in text and default not in ("", None) and not field_info.is_required():
                assert f"(default: {default})" in text, (command, name)


@pytest.mark.parametrize("url", ["postgresql://u:p@h:5432/x", "postgresql+psycopg://u@/x?host=/run/pg"])
def test_postgresql_urls_use_psycopg(url: str) -> None:
    database_url = read_settings(None, {"data": "x", "db": url}).database_url
    assert database_url.startswith("postgresql+psycopg://")
    assert database_url.split("://")[1] == url.split("://")[1]


@pytest.mark.parametrize(
    "url",
    [f"postgres://u:{PASSWORD}@h/x", f"u:{PASSWORD}@h/x", "sqlite://", "sqlite:///", "sqlite:///?mode=memory"],
)
def test_invalid_database_urls_are_rejected(url: str) -> None:
    with pytest.raises(InputError, match="db: expected sqlite:///PATH or postgresql://") as refusal:
        read_settings(None, {"data": "x", "db": url})
    assert PASSWORD not in str(refusal.value)


def test_state_folder_name_may_have_special_characters(tmp_path: Path) -> None:
    settings = read_settings(None, {"data": "x", "state_dir": tmp_path / "a st%20ate"})
    archives = ArchiveStore(settings.archive_dir, "ab")
    archives.initialise({})
    (tmp_path / "one.zip").write_bytes(b"zip")
    archives.put("one", tmp_path / "one.zip")
    assert (tmp_path / "a st%20ate" / "archives" / "one.zip").is_file()
    assert settings.database_url == f"sqlite:///{tmp_path}/a st%20ate/leaderboard.sqlite"


def test_sizes_are_parsed_with_units() -> None:
    assert read_settings(None, {"data": "x", "max_upload": "3GiB"}).max_upload == 3 << 30
    with pytest.raises(InputError, match=r"score_memory: .*, got '4 heaps'"):
        read_settings(None, {"data": "x", "score_memory": "4 heaps"})
