"""Run of the paper's scripts in this process."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType
from typing import Any

from outputs import run_script


def run(script: ModuleType, *arguments: str | Path) -> int:
    """Run a script with its arguments and return its exit status."""
    return run_script(script.argument_parser(), script.run, [str(argument) for argument in arguments])


def result_of(script: ModuleType, folder: Path, *arguments: str | Path) -> dict[str, Any]:
    """Run a script, which must succeed, and return its JSON."""
    assert run(script, *arguments, "--json", folder / "result.json") == 0
    content: dict[str, Any] = json.loads((folder / "result.json").read_text())
    return content


def written_files(script: ModuleType, folder: Path, *arguments: str | Path) -> dict[str, bytes]:
    """Run a script, which must succeed, with all outputs, and return their contents by suffix."""
    files = {suffix: folder / f"out.{suffix}" for suffix in ("json", "csv", "png")}
    options = zip(("--json", "--csv", "--figure"), files.values(), strict=True)
    assert run(script, *arguments, *(word for option in options for word in option)) == 0
    return {suffix: file.read_bytes() for suffix, file in files.items()}
