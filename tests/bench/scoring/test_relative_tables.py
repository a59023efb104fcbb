"""Tables, reports and commands of predictions that are not metric, and what refuses them."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

import rebar_depth_bench as rdb
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.rows import iterate_rows
from rebar_depth_bench.reporting.html.page import render_report, view_panels
from rebar_depth_bench.reporting.html.views import shown_view
from rebar_depth_bench.reporting.latex import latex_table
from rebar_depth_bench.reporting.tables import print_paper_table
from rebar_depth_bench.scoring.columns import interval_columns
from rebar_depth_bench.scoring.evaluation import open_evaluation
from rebar_depth_bench.scoring.formatting import constant_margin
from rebar_depth_bench.scoring.protocol import scored_pixels
from rebar_depth_bench.scoring.reading import read_result
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.submission.declaration import METRIC
from tests.bench.reporting.pages import Page
from tests.bench.reporting.test_browser import run_in_browser
from tests.bench.scoring.conftest import Values, Write, disparity

KINDS = ("scale", "affine-depth", "affine-disparity")


def test_text_of_a_result(relative: Result, tiny_root: Path, write: Write) -> None:
    lines = str(relative).splitlines()
    assert lines[0].split("  ")[-7:] == [
        *("coverage", "aligned error", "constant error", "margin", "AbsRel", "robust AbsRel", "<= 5 mm")
    ]
    table = relative.tables["lattice"]
    errors = (table["aligned.error"], table["constant.error"])
    margin = math.floor(1000 * (1 - errors[0] / errors[1])) / 10
    shown = (*errors, margin, table["aligned.abs_rel"], table["aligned_robust.abs_rel"])
    within = f"{100 * table['aligned.within_mm.5']:.1f}"
    cells = [f"{value:.4f}" if value != margin else f"{margin:.1f} %" for value in shown]
    assert " ".join(lines[1].split()) == f"lattice 100.0 % {' '.join(cells)} {within} %"
    assert lines[2] == "protocol rebar-relative-1; inputs: rgb; ground truth: not used, as declared"
    assert lines[3].startswith("affine-disparity: disparity up to scale and shift")
    assert len(lines) == 4
    assert f"aligned error {table['aligned.error']:.4g}, constant {table['constant.error']:.4g}" in repr(relative)
    assert all(line in Page(relative._repr_html_()).text for line in lines[2:])
    flat = str(rdb.score(write("flat", "affine-depth", lambda z: -z), tiny_root))
    assert re.search(r"The aligned error (0\.\d+) is not below 95 % of a constant's \(\1\)", flat)
    assert "In 9 of 9 views the fit has no positive slope" in flat


@pytest.mark.parametrize(("kind", "number"), [("metric", "scaled AbsRel"), ("scale", "aligned error")])
@pytest.mark.parametrize(("share", "is_noted"), [(-0.5, True), (0.0, True), (0.02, True), (0.1, False)])
def test_every_kind_has_one_margin_against_the_constant(
    kind: str,
    number: str,
    share: float,
    is_noted: bool,
    tiny_root: Path,
    tiny_truth: dict[str, Values],
    tmp_path: Path,
) -> None:
    """The AbsRel of depth that is moved from its median by a share of the deviation is that much below."""
    rows = rdb.load(tiny_root, "lattice", columns=["view_id", "left_mask"])
    with rdb.SubmissionWriter(tmp_path / "a.zip", "net", prediction=kind) as writer:
        for row in rows:
            depth_m = tiny_truth[row["view_id"]].astype(np.float64)
            pixels = scored_pixels(row["left_mask"], tiny_truth[row["view_id"]])
            middle = np.median(depth_m.ravel()[pixels])
            writer.add(row["view_id"], np.maximum(middle + share * (depth_m - middle), 1e-3))
    result = rdb.score(tmp_path / "a.zip", tiny_root)
    margin = constant_margin(result.tables["lattice"])
    assert margin == pytest.approx(share, abs=1e-6 if kind == "metric" else 0.1 * abs(share) + 1e-6)
    text = f"The {number} .* is not below 95 % of a constant's"
    assert any(re.search(text, note) for note in result.notes) == is_noted


def test_frames(relative: Result) -> None:
    frame, views = relative.to_pandas(), relative.to_pandas("views")
    table = json.loads(relative.to_json())["tables"]["lattice"]
    row = frame.iloc[0]
    assert (row["prediction"], row["ranked"], row["flat_views"]) == ("affine-disparity", False, 0)
    assert row["aligned_robust_within_5mm"] == table["aligned_robust"]["within_mm"]["5"]
    assert [row["constant_error_low"], row["constant_error_high"]] == table["ci95"]["constant"]["error"]
    assert "native_abs_rel" not in frame
    assert views["aligned_error"].mean() == pytest.approx(table["aligned"]["error"])
    assert not views["is_flat"].any()
    assert relative.to_pandas("groups").empty
    assert relative.metrics["lattice/aligned/within_mm/5"] == pytest.approx(row["aligned_within_5mm"])


def test_score_command(
    tiny_root: Path, tmp_path: Path, write: Write, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    metric = write("metric", None, lambda z: 1.1 * z)
    arguments = ["score", str(metric), "--data", str(tiny_root), "--align", "affine-disparity"]
    files = {name: tmp_path / f"result.{name}" for name in ("json", "csv", "html")}
    options = [text for name, path in files.items() for text in (f"--{name}", str(path))]
    assert main([*arguments, *options]) == 0
    output = capsys.readouterr()
    assert "mistake" not in output.err
    expected = rdb.score(metric, tiny_root, align="affine-disparity")
    assert files["json"].read_bytes() == expected.to_json()
    assert read_result(expected.to_json(), "result.json").to_json() == expected.to_json()
    document = expected.to_dict()
    assert (document["prediction"], document["declared_prediction"]) == ("affine-disparity", "metric")
    [row] = csv.DictReader(io.StringIO(files["csv"].read_text()))
    table = expected.tables["lattice"]
    assert float(row["aligned_error"]) == pytest.approx(table["aligned.error"])
    lines = [line.split() for line in output.out.splitlines()]
    [constant] = [line for line in lines if line[:1] == ["constant"]]
    assert constant[1:3] == [f"{value:.4f}" for value in (table["constant.error"], table["constant.abs_rel"])]
    text = Page(files["html"].read_text()).text
    for column in interval_columns(expected.kind)[1:]:
        assert column.text(table.number(column)) in text
    assert all(view.view_id in text for view in expected.views)
    declared = "etric predictions, scored as affine-disparity (--align): disparity up to scale and shift"
    assert f"M{declared}" in text
    assert f"m{declared}" in output.out
    assert f"m{declared}" in str(expected)
    assert "Rank error" not in text


def test_figure_is_refused_before_an_archive_is_scored(
    tiny_root: Path, tmp_path: Path, write: Write, capsys: Any
) -> None:
    pytest.importorskip("matplotlib")
    net, figure = write("net", "affine-disparity", disparity), tmp_path / "figure.svg"
    assert main(["table", str(net), "--data", str(tiny_root), "--figure", str(figure)]) == 2
    errors = capsys.readouterr().err
    assert "expected metric ones: the figure shows native errors" in errors
    assert "scoring" not in errors
    assert not figure.exists()


def test_table_has_a_block_for_each_kind(tiny_root: Path, tmp_path: Path, write: Write, capsys: Any) -> None:
    worse = write("worse", "affine-depth", lambda z: z**-2)
    better = write("better", "affine-depth", lambda z: 5 * z - 3)
    metric = write("sound", None, lambda z: z)
    net = write("net", "affine-disparity", disparity)
    latex, frame = tmp_path / "table.tex", tmp_path / "table.csv"
    archives = [str(path) for path in (net, worse, metric, better)]
    arguments = ["table", *archives, "--data", str(tiny_root)]
    assert main([*arguments, "--latex", str(latex), "--csv", str(frame), "--no-published"]) == 0
    out = capsys.readouterr().out
    order = [out.index(f"\n{name} ") for name in ("sound", "better", "worse", "net")]
    assert order == sorted(order)
    assert "worse: The aligned error" in out
    rows = list(csv.DictReader(io.StringIO(frame.read_text())))
    assert [row["method"] for row in rows] == ["sound", "better", "worse", "net"]
    assert [row["prediction"] for row in rows] == ["", "affine-depth", "affine-depth", "affine-disparity"]
    assert [row["flat_views"] for row in rows] == ["", "0", "9", "0"]
    text = latex.read_text()
    assert text.count(r"\begin{table*}") == 3
    blocks = text.split(r"\begin{table*}")
    assert [r"\label{tab:rebar-depth-affine-depth}" in block for block in blocks] == [False, False, True, False]
    assert blocks[2].index("better &") < blocks[2].index("worse &")
    flat = int(rows[2]["flat_views"])
    assert flat > 0
    caption = blocks[2].partition("caption")[2].splitlines()[0]
    assert f"worse, lattice ({flat} of {rows[2]['views']} views)." in caption
    assert "without a positive slope" not in blocks[1] + blocks[3]
    assert "textbf" not in blocks[2]
    assert "ddagger" not in blocks[2]
    shared = ["table", str(metric), str(net), "--data", str(tiny_root), "--align", "affine-disparity"]
    assert main(shared) == 0
    assert "rank err" not in capsys.readouterr().out


def test_compare(tiny_root: Path, write: Write, capsys: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    net = write("net", "affine-disparity", disparity)
    blurred = write("blurred", "affine-disparity", lambda z: disparity(z) + 25 * np.indices(z.shape)[1] % 3)
    metric = write("metric", None, lambda z: z)
    assert main(["compare", str(net), str(metric), "--data", str(tiny_root)]) == 2
    words = "metric has predictions of the kind metric, expected affine-disparity as net"
    errors = capsys.readouterr().err
    assert words in " ".join(errors.split())
    assert "scoring" not in errors, "kinds are refused before any archive is scored"
    assert main(["compare", str(net), str(blurred), "--data", str(tiny_root), "--json", "-"]) == 0
    [document] = json.loads(capsys.readouterr().out)
    assert document["protocol"] == "rebar-relative-1"
    rows = {row["name"]: row for row in document["configs"]["lattice"]}
    errors = [rdb.score(path, tiny_root).tables["lattice"]["aligned.error"] for path in (net, blurred)]
    assert [rows["aligned.error"][key] for key in ("first", "other")] == pytest.approx(errors)
    assert rows["aligned.error"]["verdict"] == "worse"
    assert {name.partition(".")[0] for name in rows} == {"coverage", "aligned", "aligned_robust"}
    assert main(["compare", str(net), str(blurred), "--data", str(tiny_root)]) == 0
    table = capsys.readouterr().out
    assert "…" not in table, "numbers are never truncated"
    assert "rank error" not in table


def test_marks_and_legends_are_those_of_metric_tables(write: Write, tiny_root: Path, capsys: Any) -> None:
    sparse = rdb.score(
        write("sparse", None, lambda z: np.where(z > 0.3, z, 0)), tiny_root, align="affine-disparity"
    )
    net = rdb.score(write("net", "affine-disparity", disparity), tiny_root)
    net = replace(net, tables={"lattice": net.tables["lattice"], "twin": net.tables["lattice"]})
    sparse = replace(sparse, tables={"lattice": sparse.tables["lattice"], "twin": sparse.tables["lattice"]})
    declared = {"cheat": True, "unknown": None}
    results = [sparse, net]
    for method, uses in declared.items():
        results.append(replace(net, submission=replace(net.submission, method=method, uses_ground_truth=uses)))
    print_paper_table(results, Console(width=200), published=True)
    printed = capsys.readouterr().out
    latex = latex_table(results, published=True)
    for method in ("net", "cheat ‡", "unknown ?", "sparse *"):
        assert printed.count(f"\n{method}  ") == 2, "in the table of each config"
    for text in (printed, latex):
        assert "Not ranked (declares the use of ground truth)." in text
        assert "Use of ground truth not declared." in text
        assert "Errors of valid predictions are not compared with those of others: sparse, lattice" in text
        assert "Metric predictions, aligned as this kind: sparse." in text
    rows = {
        cells[0]: cells[1:] for line in latex.splitlines() if len(cells := line.rstrip("\\ ").split(" & ")) == 6
    }
    heads = rows["Method"]
    assert len(set(heads)) == 5, "no two columns of a config have one name"
    marked = {
        row: [heads[place] for place, cell in enumerate(cells) if "$^" in cell] for row, cells in rows.items()
    }
    assert marked["sparse"] == [head for head in heads if "$E$" not in head], "of valid predictions"
    assert marked["cheat"] == [r"$E$ $\downarrow$"]
    assert "unknown$^{?}$" in rows
    assert "$1 / p = a x + b$ fitted to $1 / z$ in each view" in latex


@pytest.mark.parametrize("declared", [None, "affine-disparity"])
def test_pictures_show_aligned_depth(declared: str | None, write: Write, tiny_root: Path) -> None:
    path = write("net", declared, disparity if declared else lambda z: 3 * z)
    result = rdb.score(path, tiny_root, align="affine-disparity")
    columns = ("view_id", "left_rgb", "left_depth", "left_mask")
    rows = list(iterate_rows(open_folder(tiny_root).config("lattice"), columns))
    with open_evaluation(path, tiny_root) as evaluation:
        predictions = [evaluation.submission.read(row["view_id"]) for row in rows]
    views = list(zip(rows, predictions, result.views, strict=True))
    assert shown_view(view_panels(*views[0], declared or METRIC, METRIC)).off_scale, "without alignment"
    shown = [shown_view(view_panels(*view, declared or METRIC, result.kind)) for view in views]
    for view in shown:
        assert not view.off_scale
        assert 0.1 <= float(view.native_limit.removesuffix(" cm")) <= 3, "noise of 1 % at 0.22 to 0.43 m"
    page = Page(render_report(result, shown)).text
    assert page.count("Aligned prediction") == len(shown) == 9


@pytest.mark.parametrize("kind", KINDS)
def test_report_names_the_fit_of_each_view(kind: str, write: Write, tiny_root: Path) -> None:
    result = rdb.score(write("net", kind, lambda z: np.where(z.max() > 0.75, z.max() - z, z) + 1), tiny_root)
    page = render_report(result, [])
    fits = re.findall(r">(constant|sloped)</td>", page)
    assert fits.count("constant") == result.tables["lattice"]["flat_views"]
    assert len(fits) == (0 if kind == "scale" else 9), "a scale has no slope"
    assert ("Constant fit: a view whose fit has no positive slope" in Page(page).text) == (kind != "scale")


def test_tables_of_the_report_fit_a_window(chromium_program: str, relative: Result, tmp_path: Path) -> None:
    """No table has a scroll bar at 1200 pixels."""
    page = re.sub(r"<meta http-equiv=[^>]*>", "", render_report(relative, []))
    script = """
    document.body.style = "width: 1185px; padding: 36px; margin: 0";
    return [...document.querySelectorAll(".scroll")].map((one) => one.scrollWidth - one.clientWidth);
    """
    overflow = run_in_browser(chromium_program, page.replace("</body>\n</html>\n", ""), script, tmp_path)
    assert overflow == [0, 0]


def test_configs_of_one_archive_are_named(write: Write, tiny_root: Path, tmp_path: Path, capsys: Any) -> None:
    both = tmp_path / "both.zip"
    with rdb.SubmissionWriter(both, "both", prediction="affine-disparity") as writer:
        for config in ("lattice", "lattice-orbit"):
            for row in rdb.load(tiny_root, config, columns=["view_id", "left_depth"]):
                writer.add(row["view_id"], disparity(row["left_depth"]))
    net = write("net", "affine-disparity", disparity)
    assert main(["compare", str(both), str(net), "--data", str(tiny_root)]) == 0
    assert "only in one of both and net, not compared: lattice-orbit" in capsys.readouterr().err


def test_extended_measures_and_paper_scripts_are_refused(tiny_root: Path, write: Write, capsys: Any) -> None:
    net = write("net", "affine-disparity", disparity)
    assert main(["score", str(net), "--data", str(tiny_root), "--extended"]) == 2
    assert "expected metric ones: extended measures are in metres" in capsys.readouterr().err
    metric = write("metric", None, lambda z: z)
    assert main(["score", str(metric), "--data", str(tiny_root), "--extended", "--align", "scale"]) == 2
    assert "--align and --extended are both given" in capsys.readouterr().err
    with pytest.raises(rdb.InputError, match="extended is true and kind is scale"):
        rdb.Evaluator(tiny_root, "lattice", extended=True, kind="scale")


def test_disparity_is_no_mistake(tiny_root: Path, write: Write, capsys: Any) -> None:
    def check(name: str, kind: str, make: Callable[[Values], Values]) -> str:
        assert main(["check", str(write(name, kind, make)), "--data", str(tiny_root)]) == 0
        return str(capsys.readouterr().err)

    with np.errstate(divide="ignore"):
        assert "mistake" in check("undeclared", "metric", lambda z: 1 / z)
    declared = check("declared", "affine-disparity", disparity)
    assert "mistake" not in declared
    assert "not ranked: " in declared
    assert "affine-disparity, expected metric ones: the leaderboard ranks depth in metres" in declared
    assert "not ranked" not in check("undeclared", "metric", lambda z: z)
    assert "mistake" not in check("millimetres", "scale", lambda z: 1000 * z)
    assert "mistake" not in check("negative", "affine-depth", lambda z: z - 90)
    assert "0.0 % are finite and above 0" in check("none", "scale", lambda z: z - 90)
    assert "0.0 % are finite\n" in check("infinite", "affine-depth", lambda z: z * np.inf)
    assert "the same at all pixels in 8 of 8 views" in check("zero", "affine-depth", lambda z: 0 * z)


def test_evaluation_of_another_kind(tiny_root: Path, tiny_truth: dict[str, np.ndarray], tmp_path: Path) -> None:
    predictions = {view_id: disparity(depth_m) for view_id, depth_m in tiny_truth.items()}
    options: Any = {"config": "lattice", "kind": "affine-disparity", "method": "net"}
    result = rdb.evaluate(predictions, tiny_root, **options, archive=tmp_path / "net.zip")
    unwritten = rdb.evaluate(predictions, tiny_root, **options)
    assert unwritten.to_dict()["tables"] == result.to_dict()["tables"]
    assert result.to_json() == rdb.score(tmp_path / "net.zip", tiny_root).to_json()
    assert result.notes[0].startswith("affine-disparity: disparity up to scale and shift")
    assert len(result.notes) == 1
    result.to_html(tmp_path / "report.html")
    assert "affine-disparity" in Page((tmp_path / "report.html").read_text()).text
