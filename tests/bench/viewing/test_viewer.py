"""Start of rerun's viewer: a program in its place records how it is called."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

pytest.importorskip("rerun_cli")

import rerun_cli

from rebar_depth_bench.errors import InputError, RebarDepthError
from rebar_depth_bench.viewing.viewer import show_recording

RERUN = Path(rerun_cli.__file__).with_name("rerun")


@pytest.fixture
def calls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Put a script in the place of rerun's program: it keeps its settings, arguments and recording in a folder."""
    folder = tmp_path / "calls"
    folder.mkdir()
    script = tmp_path / "rerun"
    script.write_text(
        f'#!/bin/sh\nif [ "$1" = analytics ]; then exec {RERUN} "$@"; fi\ncd {folder}\n'
        'echo "$@" > arguments\ncp "$XDG_CONFIG_HOME/rerun/analytics.json" .\n'
        'for last; do :; done\ncp "$last" recording\nexit "${EXIT:-0}"\n'
    )
    script.chmod(0o755)
    monkeypatch.setenv("RERUN_CLI_PATH", str(script))
    monkeypatch.setenv("DISPLAY", ":0")
    return folder


def test_viewer_shows_recording_and_sends_nothing(calls: Path) -> None:
    show_recording(b"RRF2")
    assert (calls / "recording").read_bytes() == b"RRF2"
    assert json.loads((calls / "analytics.json").read_text())["analytics_enabled"] is False
    arguments = (calls / "arguments").read_text()
    assert "--hide-welcome-screen" in arguments
    assert "--bind 127.0.0.1" in arguments
    assert not Path(arguments.split()[-1]).exists()


def test_failure_of_viewer_is_reported(calls: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EXIT", "7")
    with pytest.raises(RebarDepthError, match="7"):
        show_recording(b"RRF2")


def test_viewer_needs_display(calls: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(InputError):
        show_recording(b"RRF2")
    assert not list(calls.iterdir())
