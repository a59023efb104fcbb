"""Tables in the terminal and as CSV: golden texts, widths, notes, escaping, and published rows of the paper."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from cards.reference import coverage_text
from rebar_depth_bench import software_version
from rebar_depth_bench.base.errors import printable
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.extended.estimates import MeasureEstimate
from rebar_depth_bench.extended.families import MEASURE_FAMILIES
from rebar_depth_bench.reporting.detections import DetectionPage, PageTable, print_page
from rebar_depth_bench.reporting.extended_tables import format_value
from rebar_depth_bench.reporting.html.extended import estimate_cell
from rebar_depth_bench.reporting.html.page import render_report
from rebar_depth_bench.reporting.latex import latex_table
from rebar_depth_bench.reporting.published import published_rows
from rebar_depth_bench.reporting.tables import (
    comparison_cells,
    disambiguate_method_names,
    print_comparison,
    print_paper_table,
    print_table,
)
from rebar_depth_bench.scoring import formatting
from rebar_depth_bench.scoring.columns import DASH, METRICS, coverage_percent, number
from rebar_depth_bench.scoring.comparison import compare
from rebar_depth_bench.scoring.result import DatasetIdentity, Result, SoftwareIdentity
from rebar_depth_bench.scoring.spreadsheet import tables_sheet
from rebar_depth_bench.scoring.table import Table
from tests.bench.reporting.pages import Page
from tests.bench.reporting.results import (
    HOSTILE,
    example,
    examples,
    joined,
    result,
    scored_view,
    split_result,
    table_of,
)

Show = Callable[[Console], None]

GOLDEN: dict[str, tuple[int, Show]] = {
    "score-80.txt": (80, lambda console: print_table(example(), console)),
    "score-160.txt": (160, lambda console: print_table(example(), console)),
    "table.txt": (80, lambda console: print_paper_table(examples(), console, published=True)),
}
NAME = "[link=x]a[/link]\x1b[2J\x9b2J\u202e\x07[/]"
MARKUP = "[link=x]a[/link]"


def printed(show: Show, width: int, *, terminal: bool = False) -> str:
    console = Console(width=width, file=io.StringIO(), force_terminal=terminal, color_system=None)
    show(console)
    return console.file.getvalue()  # type: ignore[attr-defined, no-any-return]


def printed_result(shown: Result, width: int) -> str:
    return printed(lambda console: print_table(shown, console), width)


@pytest.mark.parametrize("name", GOLDEN)
def test_terminal_tables_are_the_golden_texts(name: str, check_golden: Callable[[str, str], None]) -> None:
    width, show = GOLDEN[name]
    text = printed(show, width)
    assert max(map(len, text.splitlines())) <= width
    check_golden(name, text.replace(software_version(), "VERSION"))


def test_csv_is_the_golden_text(check_golden: Callable[[str, str], None]) -> None:
    check_golden("score.csv", tables_sheet([example()]).to_csv())
    check_golden("groups.csv", tables_sheet([example()], groups=True).to_csv())
    [header] = tables_sheet([result(scored_view("lattice/0000"))], groups=True).to_csv().splitlines()
    assert header == tables_sheet([example()], groups=True).to_csv().partition("\n")[0]


@pytest.mark.parametrize(("width", "tables"), [(40, 3), (80, 3), (100, 2), (140, 2), (160, 1), (200, 1)])
def test_table_splits_on_a_narrow_console_and_has_all_numbers(width: int, tables: int) -> None:
    text = printed_result(result(scored_view("lattice/0000"), scored_view("lattice/0001")), width)
    assert sum(line.startswith("config") for line in text.splitlines()) == tables
    rows = [line.split() for line in text.splitlines() if line.split()[:1] == ["lattice"]]
    assert {cell for row in rows for cell in row[1:]} == {
        *("2/2", "100.0", "0.4286", "0.7500", "20.09", "18.71", "0.123"),
        *("0.0613", "1.52", "1.17", "0.988", "0.625", "1.2", "4.6", "7.9", "13.6"),
    }


def test_notes_and_published_rows_appear_only_where_they_apply() -> None:
    text = printed_result(result(scored_view("lattice/0000")), 160)
    assert DASH not in text
    assert "group" not in text
    assert "Errors of valid predictions" not in text
    own = printed(
        lambda console: print_paper_table([result(scored_view("pier/0000"))], console, published=False), 80
    )
    assert "paper" not in own
    assert "Not ranked: no views." in formatting.table_notes(table_of([]))


def test_results_of_some_views_are_named_and_not_marked_as_declared() -> None:
    """Only the declared use of ground truth has its mark."""
    some, whole = result(scored_view("lattice/0000"), method="some"), result(scored_view("lattice/0000"))
    some = replace(some, tables={"lattice": some.tables["lattice"].of_some_views(9)})
    text = printed(lambda console: print_paper_table([some, whole], console, published=False), 80)
    assert "‡" not in text
    assert "Not ranked: some, lattice (1 of 9 views)." in text
    assert "Not ranked: some, lattice (1 of 9 views)." in latex_table([some, whole], published=False)


@pytest.mark.parametrize("share", [0.79496, 0.94999, 0.99999, 0.5, 1.0])
def test_coverage_is_rounded_down_in_every_display(share: float) -> None:
    text = f"{math.floor(1000 * share) / 10:.1f}"
    shown = result(scored_view("lattice/0000", coverage=share))
    measure = MEASURE_FAMILIES["single_bar"].by_name["single_bar_coverage"]
    displays = {
        "print": str(shown).splitlines()[1].split()[1],
        "notebook": next(cell for cell in Page(shown._repr_html_()).text.split() if cell.startswith(text[:2])),
        "terminal": printed_result(shown, 160).split("2/2")[-1].split("1/1")[-1].split()[0],
        "cards": coverage_text(share).removesuffix(" %"),
        "extended": format_value(share, measure),
        "extended, page": estimate_cell(MeasureEstimate(share, None, 1), measure).text,
        "compare": comparison_cells(compare(shown, shown).configs["lattice"][0])[1],
    }
    assert displays == dict.fromkeys(displays, text)


def test_notes_state_what_is_resampled() -> None:
    one_scene = result(*(scored_view(f"lattice/{12 * index:04d}") for index in range(8)))
    split = split_result()
    both = joined(split, one_scene)
    assert formatting.interval_note(one_scene.tables.values()) == formatting.INTERVAL_NOTE
    for shown in (one_scene, split):
        assert formatting.interval_note(shown.tables.values()) in render_report(shown, [])
    assert "views" not in formatting.interval_note(split.tables.values())
    assert formatting.interval_note(both.tables.values()).startswith(formatting.INTERVAL_NOTE)
    latex = [latex_table([shown], published=False, intervals=True) for shown in (one_scene, split, both)]
    phrases = ("block bootstrap over views", "bootstrap over scenes", "over views, with splits over scenes")
    assert all(phrase in " ".join(text.split()) for phrase, text in zip(phrases, latex, strict=True))


def with_scaled_constant(table: Table, abs_rel: float) -> Table:
    return replace(table, numbers={**table.numbers, "reference.scaled_constant.abs_rel": abs_rel})


def test_constants_of_results_on_other_pixels_are_named() -> None:
    """The constants of two results without some pixels look alike and share a row."""
    named = {"a": 1.0, "b": 0.9, "c\x1b": 0.8, "d": 1.0}
    tables = {name: result(scored_view("lattice/0000", coverage=share)) for name, share in named.items()}
    rows = [(name, one.tables["lattice"]) for name, one in tables.items()]
    assert formatting.scaled_constants(rows) == {
        "constant": (0.0571, 2.21),
        "constant, b, c\N{REPLACEMENT CHARACTER}": (0.0529, 2.05),
    }
    assert formatting.scaled_constants(rows[1:3]) == {"constant": (0.0529, 2.05)}
    titles = [title for title, _ in formatting.reference_rows(rows)]
    assert titles == [*formatting.scaled_constants(rows), "one pixel"]
    without = with_scaled_constant(rows[0][1], math.nan)
    assert formatting.reference_rows([("x", without)])[0][0] == "one pixel"


def test_names_of_references_fit_a_line() -> None:
    other = scored_view("lattice/0000", coverage=0.9)
    two = [result(scored_view("lattice/0000"), method="full"), result(other, method="sgbm")]
    text = printed(lambda console: print_paper_table(two, console, published=False), 80)
    assert "reference: constant, sgbm  " in text


def test_scaled_error_is_compared_with_the_constant_on_the_same_pixels() -> None:
    table = result(scored_view("lattice/0000", coverage=0.9)).tables["lattice"]
    assert any("of a constant's (0.0529)" in finding for finding in formatting.reference_findings(table))
    between = with_scaled_constant(table, 0.07)
    assert not any("constant" in finding for finding in formatting.reference_findings(between))


@pytest.mark.parametrize(
    ("shown", "text"),
    [
        (coverage_percent(0.94999), "94.9"),
        (coverage_percent(0.99999), "99.9"),
        (coverage_percent(0.283), "28.3"),
        (coverage_percent(1.0), "100.0"),
        (number(0.00004, 4), "4.0e-05"),
        (number(0.00005, 4), "0.0001"),
        (number(0.0, 4), "0.0000"),
        (METRICS["rmse_cm"].text(1.2e-17), "0.00"),
        (METRICS["rmse_cm"].text(1.2e-9), "1.2e-09"),
        (number(2e6, 2), "2.0e+06"),
        (number(float("nan"), 2), DASH),
    ],
)
def test_coverage_is_rounded_down_and_extreme_numbers_are_scientific(shown: str, text: str) -> None:
    assert shown == text


@pytest.mark.parametrize("method", [HOSTILE, "+1", "-1", "@x", "a\rb\nc"])
def test_csv_has_neither_formulas_nor_control_characters(method: str) -> None:
    content = tables_sheet([result(scored_view("lattice/0000"), method=method)]).to_csv()
    row = next(csv.DictReader(io.StringIO(content, newline="")))
    assert row["method"] == ("" if method.startswith("a") else "'") + printable(method)
    [group] = [
        line for line in tables_sheet([split_result(HOSTILE)], groups=True).to_csv().splitlines() if "evil" in line
    ]
    assert "'=" in group


def hostile_result() -> Result:
    """Return a result whose texts are all hostile."""
    shown = result(scored_view(f"{NAME.replace('/', '|')}/0000"), method=NAME)
    return replace(
        shown,
        dataset=DatasetIdentity(NAME, NAME),
        submission=replace(shown.submission, sha256=NAME),
        software=SoftwareIdentity(NAME),
    )


def hostile_page() -> DetectionPage:
    """Return a page of a detector whose texts are all hostile."""
    table = PageTable(NAME, [("k", NAME), (NAME, "")], [["1", NAME]])
    return DetectionPage(NAME, NAME, stamps=[(NAME, NAME)], figures=[], tables=[table], notes=[NAME])


@pytest.mark.parametrize(
    "show",
    [
        lambda console: print_table(hostile_result(), console),
        lambda console: print_table(split_result(NAME, NAME), console),
        lambda console: print_paper_table([hostile_result()], console, published=True),
        lambda console: print_comparison(compare(hostile_result(), hostile_result()), console),
        lambda console: print_page(hostile_page(), console),
    ],
    ids=["score", "groups", "table", "compare", "score-crossings"],
)
@pytest.mark.parametrize("width", [60, 160])
def test_names_print_as_plain_text(show: Show, width: int) -> None:
    text = printed(show, width, terminal=True)
    assert all(line.isprintable() for line in text.split("\n")), text
    assert MARKUP in "".join(text.split()) or MARKUP.replace("/", "|") in "".join(text.split())


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
    text = capsys.readouterr().out
    assert all(line.isprintable() for line in text.split("\n")), text
    assert "[/bold]" in text
    assert "[/red]" in text
    out = tmp_path / "out.zip"
    arguments = ["predict", f"{tmp_path / 'their_method.py'}:METHOD", "--data", str(tiny_root), "--out", str(out)]
    assert main([*arguments, "--config", "lattice"]) == 0
    noted = capsys.readouterr().err
    assert all(line.isprintable() for line in noted.split("\n")), noted


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
    assert main(["table", archives[0], archives[0], "--data", str(tiny_root)]) == 0
    labels = re.findall(r"^test \(\w+\)(?: 2)?", capsys.readouterr().out, re.MULTILINE)
    assert labels == [labels[0], f"{labels[0]} 2"], "one archive twice"
    assert main(["table", "nowhere.zip", "--data", str(tiny_root)]) == 2
    assert "does not exist" in capsys.readouterr().err


# Table I of the paper, transcribed independently of published.json; columns: lattice, disordered, pier.
TABLE_1 = """
FoundationStereo 1.13 0.021 0.022 1.00 1.53 0.009 0.010 1.00 312.8 0.105 0.103 0.97
COLMAP+ArUco 1.60 0.021 0.028 1.01 2.03 0.012 0.011 1.00 206.7 0.078 0.083 0.98
Metric3D_v2 20.09 0.750 0.061 0.63 20.46 0.275 0.058 1.36 1143 0.888 0.186 12.58
Depth_Pro 91.19 3.145 0.029 0.25 15.46 0.262 0.043 0.92 1151 0.901 0.179 12.17
Depth_Anything_3_Metric 96.93 3.469 0.043 0.23 35.31 0.644 0.051 0.72 1073 0.832 0.147 6.60
UniDepth_v2 151.5 5.883 0.030 0.16 18.52 0.264 0.038 1.25 869.4 0.654 0.154 3.16
"""


@pytest.mark.parametrize(("scene", "column"), [("lattice", 1), ("pile", 5), ("pier", 9)])
def test_published_rows_are_those_of_the_paper(scene: str, column: int) -> None:
    expected = [line.split() for line in TABLE_1.split("\n") if line]
    rows = published_rows(scene)
    assert [row.method.replace(" ", "_") for row in rows] == [line[0] for line in expected]
    for row, line in zip(rows, expected, strict=True):
        values = [row.rmse_cm, row.abs_rel, row.abs_rel_scaled, row.scale]
        assert values == line[column : column + 4]
        assert row.median_anchored == (scene == "pier" and row.method == "COLMAP+ArUco")


def test_names_that_occur_twice_get_no_name_of_another() -> None:
    names = ["x", "x", "x (01234567)", "x (01234567) 3"]
    results = [result(scored_view("lattice/0000"), method=name) for name in names]
    found = [one.method for one in disambiguate_method_names(results)]
    assert found == ["x (01234567) 2", "x (01234567) 4", *names[2:]]
