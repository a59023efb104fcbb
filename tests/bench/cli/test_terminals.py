"""Terminals that are not UTF-8 or closed, and progress with rate and remaining time."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from rebar_depth_bench.base.terminal import MAX_SILENCE_S, ProgressBars, prepare_terminal
from rebar_depth_bench.cli.main import main
from tests.commands import run_in_process

SIGNS = "\N{DOWNWARDS ARROW} \N{MINUS SIGN}\N{PLUS-MINUS SIGN}\N{DAGGER}\N{MULTIPLICATION SIGN}"


@pytest.mark.parametrize(
    ("encoding", "shown"),
    [
        ("ascii", "? ????"),
        ("cp1252", "? ?\N{PLUS-MINUS SIGN}\N{DAGGER}\N{MULTIPLICATION SIGN}"),
        ("utf-8", SIGNS),
    ],
)
def test_only_missing_characters_are_replaced(encoding: str, shown: str, monkeypatch: pytest.MonkeyPatch) -> None:
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, encoding, errors="strict"))
    prepare_terminal()
    print(f"{SIGNS}\udcff", end="", flush=True)
    assert written.getvalue().decode(encoding) == f"{shown}?"


@pytest.fixture(scope="module")
def scored(tiny_root: Path, tmp_path_factory: pytest.TempPathFactory) -> list[str | Path]:
    """Return the start of a command that scores an archive."""
    archive = tmp_path_factory.mktemp("terminals") / "a.zip"
    command = ("predict", "constant", "--data", tiny_root, "--config", "lattice-orbit", "--out", archive)
    assert run_in_process(main, *command).returncode == 0
    return ["score", archive, "--data", tiny_root]


@pytest.mark.slow
def test_commands_run_on_plain_terminals(scored: list[str | Path], tmp_path: Path) -> None:
    environment = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    score = [str(word) for word in scored]
    for name, arguments in {
        "methods": ["methods"],
        "ascii": [*score, "--csv", str(tmp_path / "ascii.csv"), "--html", str(tmp_path / "ascii.html")],
        "utf-8": [*score, "--csv", str(tmp_path / "utf-8.csv"), "--html", str(tmp_path / "utf-8.html")],
    }.items():
        encoding = "utf-8" if name == "utf-8" else "ascii"
        finished = subprocess.run(
            [sys.executable, "-m", "rebar_depth_bench", *arguments],
            env={**environment, "PYTHONIOENCODING": encoding},
            capture_output=True,
            timeout=100,
            check=False,
        )
        assert finished.returncode == 0, finished.stderr
        assert finished.stdout.isascii() == (encoding == "ascii")
    for suffix in ("csv", "html"):
        content = (tmp_path / f"ascii.{suffix}").read_bytes()
        assert content == (tmp_path / f"utf-8.{suffix}").read_bytes()
    assert not content.isascii()


@pytest.mark.parametrize("width", ["0", "00"])
def test_width_of_0_counts_as_unset(width: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    expected = run_in_process(main, "methods").stdout
    assert expected.strip()
    monkeypatch.setenv("COLUMNS", width)
    assert run_in_process(main, "methods").stdout == expected


def in_shell(redirections: str, *command: str | Path) -> subprocess.CompletedProcess[str]:
    """Run ``rebar-bench`` with redirections of its streams that a shell makes."""
    words = ["bash", "-c", f'"$@" {redirections}', "bash", sys.executable, "-m", "rebar_depth_bench", *command]
    return subprocess.run(words, capture_output=True, text=True, timeout=100, check=False)


@pytest.mark.parametrize(
    ("redirections", "status"),
    [
        (">&-", 0),
        ("2>&-", 0),
        ("<&- >&- 2>&-", 0),
        ("2>/dev/full", 0),
        ("2</dev/null", 0),
        ("2> >(true)", 0),
        ("</dev/null >&0", 1),
    ],
)
def test_closed_streams_lose_no_file(
    redirections: str, status: int, scored: list[str | Path], tmp_path: Path
) -> None:
    """Files, standard output that is open, and exit status are as with open streams; there is no traceback."""
    names = ("a.json", "a.csv", "a.html")
    outputs = [(f"--{Path(name).suffix[1:]}", tmp_path / name) for name in names]
    words = [word for output in outputs for word in output]
    expected = run_in_process(main, *scored, *words)
    assert expected.returncode == 0, expected.stderr
    contents = [(tmp_path / name).read_bytes() for name in names]
    for name in names:
        (tmp_path / name).unlink()
    finished = in_shell(redirections, *scored, *words)
    assert finished.returncode == status, finished.stderr
    assert [(tmp_path / name).read_bytes() for name in names] == contents
    assert finished.stdout == ("" if ">&" in redirections.replace("2>&-", "") else expected.stdout)
    assert "Traceback" not in finished.stderr


def test_closed_standard_output_is_no_file(scored: list[str | Path]) -> None:
    finished = in_shell(">&-", *scored, "--json", "-")
    assert finished.returncode == 2
    assert "standard output is closed" in finished.stderr


@pytest.mark.parametrize(
    ("module", "words"),
    [
        ("rebar_depth_bench.cli.main", ["score", "a.zip", "--data", "data", "--json", "a.json"]),
        ("dataset_builder.cli.main", ["--out", "data", "--dry-run"]),
        ("leaderboard.__main__", ["check", "--data", "data"]),
    ],
)
def test_removed_current_folder_is_named(module: str, words: list[str], tmp_path: Path) -> None:
    if module == "leaderboard.__main__":
        pytest.importorskip("fastapi")
    enter = "os.chdir(sys.argv.pop(1)); os.rmdir(os.getcwd())"
    start = f"import os, sys; from {module} import main; {enter}; sys.exit(main())"
    gone = tmp_path / "gone"
    gone.mkdir()
    command = [sys.executable, "-P", "-c", start, str(gone), *words]
    finished = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert finished.returncode == 2
    assert finished.stderr.startswith("error: the current folder was removed")
    assert "Traceback" not in finished.stderr


Lines = Callable[[list[tuple[float, int]]], list[str]]


@pytest.fixture
def lines_of(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Lines:
    """Return a function that returns the log of updates, each some seconds after the one before."""

    def log(updates: list[tuple[float, int]]) -> list[str]:
        now_s = 1000.0
        monkeypatch.setattr("rebar_depth_bench.base.terminal.time.monotonic", lambda: now_s)
        with ProgressBars(pictures_per_step=2) as bars:
            for seconds, done in updates:
                now_s += seconds
                bars.update("pile", done, 504)
        return capsys.readouterr().err.splitlines()

    return log


def test_log_has_the_rate_since_the_build_was_resumed(lines_of: Lines) -> None:
    lines = lines_of([(0, 250), (30, 251), (30, 252), (30, 253)])
    assert lines == ["pile: 250 of 504", "pile: 252 of 504, 4 pictures/min, 2:06:00 left"]


def test_log_is_short_but_never_silent_for_long(lines_of: Lines) -> None:
    fast = lines_of([(1, done) for done in range(505)])
    assert len(fast) == 11
    slow = lines_of([(100, done) for done in range(51)])
    assert len(slow) == 1 + 50 * 100 // MAX_SILENCE_S
