"""Comparison table of several submissions, in the terminal and from the ``table`` command."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from rebar_depth_bench.cli.main import main
from rebar_depth_bench.reporting.published import load_published, published_rows
from rebar_depth_bench.reporting.tables import print_paper_table
from tests.bench.reporting.results import HOSTILE, result, scored_view, unpredicted_view


def table_text(*results: object, published: bool = True) -> str:
    console = Console(width=80, record=True, file=io.StringIO())
    print_paper_table(results, console, published=published)  # type: ignore[arg-type]
    return console.export_text()


def test_rows_are_sorted_best_first_unranked_last() -> None:
    text = table_text(
        result(scored_view("lattice/0000", 0.75), method="far"),
        result(unpredicted_view("lattice/0000"), method="silent"),
        result(scored_view("lattice/0000", 0.25), method="near"),
    )
    assert text.index("near") < text.index("far") < text.index("silent")


def test_published_rows_are_shown_with_scene_and_mark() -> None:
    text = table_text(result(scored_view("pier/0000"), scored_view("mine/0000")))
    for row in published_rows("pier"):
        assert all(word in text for word in ("paper:", *row.method.split()))
        assert row.rmse_cm in text
    assert "paper: COLMAP+ArUco †" in text
    assert text.count("paper: Depth Pro") == 1
    mark = load_published().parts["synthetic"].mark
    assert mark in " ".join(text.split())
    assert "paper" not in table_text(result(scored_view("pier/0000")), published=False)


def test_hostile_name_is_escaped_within_80_columns() -> None:
    text = table_text(result(scored_view("lattice/0000"), method=HOSTILE))
    assert "\x1b[31m" not in text
    assert "=<script" in text
    assert max(map(len, text.splitlines())) <= 80


def test_table_command_writes_latex_and_csv(
    tiny_truth: dict[str, np.ndarray],
    tiny_root: Path,
    archive_of: Callable[..., Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    archives = [
        str(archive_of({view: factor * depth for view, depth in tiny_truth.items()}, f"{factor}.zip"))
        for factor in (1.0, 1.5)
    ]
    latex, table = tmp_path / "table.tex", tmp_path / "table.csv"
    command = ["table", *archives, "--data", str(tiny_root), "--latex", str(latex), "--csv", str(table)]
    assert main(command) == 0
    rows = list(csv.DictReader(io.StringIO(table.read_text())))
    assert [float(row["native_abs_rel"]) for row in rows] == pytest.approx([0, 0.5], abs=1e-6)
    assert [json.loads(row["ranked"]) for row in rows] == [True, True]
    assert r"\begin{tabular}" in latex.read_text()
    assert "AbsRel_s" in capsys.readouterr().out


def test_missing_archive_exits_with_status_2(tiny_root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["table", "nowhere.zip", "--data", str(tiny_root)]) == 2
    assert "does not exist" in capsys.readouterr().err
