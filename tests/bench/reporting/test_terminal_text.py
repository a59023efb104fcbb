"""Names from files and methods on the terminal: neither control characters nor markup have an effect."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from rebar_depth_bench.cli.main import main
from rebar_depth_bench.reporting.detections import DetectionPage, PageTable, print_page
from rebar_depth_bench.reporting.tables import print_comparison, print_paper_table, print_table
from rebar_depth_bench.scoring.comparison import compare
from rebar_depth_bench.scoring.result import DatasetIdentity, Result, SoftwareIdentity
from tests.bench.reporting.results import result, scored_view

NAME = "[link=x]a[/link]\x1b[2J\x9b2J\u202e\x07[/]"
MARKUP = "[link=x]a[/link]"


def hostile_result() -> Result:
    config = NAME.replace("/", "|")
    shown = result(scored_view(f"{config}/0000"), method=NAME)
    return replace(
        shown,
        dataset=DatasetIdentity(NAME, NAME),
        submission=replace(shown.submission, sha256=NAME),
        software=SoftwareIdentity(NAME),
    )


def page() -> DetectionPage:
    return DetectionPage(
        title=NAME,
        lead=NAME,
        stamps=[(NAME, NAME)],
        figures=[],
        tables=[PageTable(NAME, [("k", NAME), (NAME, "")], [["1", NAME]])],
        notes=[NAME],
    )


@pytest.mark.parametrize(
    "show",
    [
        lambda console: print_table(hostile_result(), console),
        lambda console: print_paper_table([hostile_result()], console, published=True),
        lambda console: print_comparison(compare(hostile_result(), hostile_result()), console),
        lambda console: print_page(page(), console),
    ],
    ids=["score", "table", "compare", "score-crossings"],
)
@pytest.mark.parametrize("width", [60, 160])
def test_names_print_as_plain_text(show: Callable[[Console], None], width: int) -> None:
    console = Console(width=width, file=io.StringIO(), force_terminal=True, color_system=None)
    show(console)
    printed = console.file.getvalue()  # type: ignore[attr-defined]
    assert all(line.isprintable() for line in printed.split("\n")), printed
    assert MARKUP in "".join(printed.split()) or MARKUP.replace("/", "|") in "".join(printed.split())


METHOD = """
from dataclasses import replace
from rebar_depth_bench.methods import METHODS
constant = METHODS["constant"]
METHOD = replace(constant, info=replace(constant.info, summary=NAME, source=NAME, licence=NAME))
"""


def test_methods_and_their_errors_print_as_plain_text(
    tiny_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    info = tmp_path / "theirs-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: theirs\nVersion: 1\n")
    entries = "[rebar_depth_bench.methods]\n[/bold] = their_method:METHOD\n[/red] = nowhere_at_all:X\n"
    (info / "entry_points.txt").write_text(entries)
    (tmp_path / "their_method.py").write_text(f"NAME = {NAME!r}\n{METHOD}")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert main(["methods"]) == 0
    printed = capsys.readouterr().out
    assert all(line.isprintable() for line in printed.split("\n")), printed
    assert "[/bold]" in printed
    assert "[/red]" in printed
    out = tmp_path / "out.zip"
    arguments = ["predict", f"{tmp_path / 'their_method.py'}:METHOD", "--data", str(tiny_root), "--out", str(out)]
    assert main([*arguments, "--config", "lattice"]) == 0
    noted = capsys.readouterr().err
    assert all(line.isprintable() for line in noted.split("\n")), noted
