"""Terminals that are not UTF-8: plain replacements in place of an error, while files stay UTF-8."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from pathlib import Path

import pytest

from rebar_depth_bench.base.terminal import plain_characters, use_plain_characters
from rebar_depth_bench.cli.main import main
from tests.commands import run_in_process


@pytest.mark.parametrize(
    ("text", "plain"),
    [
        ("AbsRel ↓, % ↑", "AbsRel v, % ^"),
        ("0.1 → 0.2", "0.1 > 0.2"),
        ("−0.5 ± 0.1 × 3", "-0.5 +- 0.1 x 3"),
        ("pier †, 8 – 17 m …", "pier +, 8 - 17 m ..."),
        ("Säule № 1, δ1 < 1.25²", "Saule No 1, d1 < 1.252"),
        ("鉄 \udcff", "? ?"),
    ],
)
def test_characters_have_plain_replacements(text: str, plain: str) -> None:
    assert plain_characters(text) == plain


SIGNS = "\N{DOWNWARDS ARROW} \N{MINUS SIGN}\N{PLUS-MINUS SIGN}\N{DAGGER}\N{MULTIPLICATION SIGN}"


@pytest.mark.parametrize(
    ("encoding", "shown"),
    [
        ("ascii", "v -+-+x"),
        ("cp1252", "v -\N{PLUS-MINUS SIGN}\N{DAGGER}\N{MULTIPLICATION SIGN}"),
        ("latin-1", "v -\N{PLUS-MINUS SIGN}+\N{MULTIPLICATION SIGN}"),
        ("utf-8", SIGNS),
    ],
)
def test_only_missing_characters_are_replaced(encoding: str, shown: str, monkeypatch: pytest.MonkeyPatch) -> None:
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, encoding, errors="strict"))
    use_plain_characters()
    print(f"{SIGNS}\udcff", end="", flush=True)
    assert written.getvalue().decode(encoding) == f"{shown}?"


@pytest.mark.slow
def test_commands_run_on_plain_terminals(tiny_root: Path, tmp_path: Path) -> None:
    archive = tmp_path / "a.zip"
    command = ("predict", "constant", "--data", tiny_root, "--config", "lattice-orbit", "--out", archive)
    assert run_in_process(main, *command).returncode == 0
    environment = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    score = ["score", str(archive), "--data", str(tiny_root)]
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
