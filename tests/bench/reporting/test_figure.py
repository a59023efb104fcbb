"""Figure of native against scaled AbsRel: points and texts as Matplotlib has them, files, and the option."""

from __future__ import annotations

import io
import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.commands import run_in_process

pytest.importorskip("matplotlib")

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import rebar_depth_bench as rdb
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.reporting.figure import (
    _STYLE,
    check_figure,
    draw_figure,
    figure_style,
    write_figure,
)
from rebar_depth_bench.reporting.published import published_rows
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.scoring.table import PublishedMatch, ViewScore
from rebar_depth_bench.submission.declaration import Declaration
from tests.bench.reporting.results import (
    HOSTILE,
    REFERENCE,
    changed,
    overflowed_view,
    result,
    scored_view,
    split_result,
    unpredicted_view,
)

Point = tuple[float, float]


@pytest.fixture(autouse=True)
def _style() -> Iterator[None]:
    with figure_style(_STYLE):
        yield


def view(view_id: str, native: float, scaled: float, coverage: float = 1.0) -> ViewScore:
    return changed(scored_view(view_id, native, coverage), {"scaled.abs_rel": scaled})


def drawn(*results: Result, published: bool = True) -> Figure:
    return draw_figure(results, published=published)


def points(axes: Axes, *, hollow: bool = False) -> dict[str, Point]:
    """Return native and scaled errors by method, of markers that are hollow or not."""
    lines = [line for line in axes.lines if line.get_linestyle() == "None"]
    return {
        str(line.get_label()).removeprefix("paper: "): tuple(np.array(line.get_xydata())[0].tolist())
        for line in lines
        if (line.get_markerfacecolor() == "#ffffff") == hollow
    }


def references(axes: Axes) -> tuple[list[float], list[float]]:
    """Return the scaled errors of lines across a panel, and the native errors of lines up a panel."""
    lines = [np.array(line.get_xydata()) for line in axes.lines if line.get_linestyle() != "None"]
    across = [ends[0, 1] for ends in lines if ends[0, 1] == ends[1, 1]]
    return across, [ends[0, 0] for ends in lines if ends[0, 0] == ends[1, 0]]


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_points_and_references_have_their_errors() -> None:
    near = result(view("lattice/0000", 0.04, 0.03), method="near")
    far = result(view("lattice/0000", 0.8, 0.05, coverage=0.9), method="far")
    figure = drawn(near, far)
    [axes] = figure.axes
    rows = published_rows("lattice")
    published = {row.method: (float(row.abs_rel), float(row.abs_rel_scaled)) for row in rows}
    assert points(axes) == {**published, "near": (0.04, 0.03)}
    assert points(axes, hollow=True) == {"far": (0.8, 0.05)}
    across, up = references(axes)
    assert across == [REFERENCE["reference.constant.abs_rel"], pytest.approx(0.0529)]
    assert up == [REFERENCE["reference.one_pixel.abs_rel"]]
    names = legend(figure)
    assert names[:2] == ["near", "far"]
    assert names[2:8] == [f"paper: {row.method}" for row in rows]
    assert [name.partition(" (")[0] for name in names[8:]] == [
        "reference: constant",
        "reference: one pixel",
        "native = scaled",
    ]


@pytest.mark.parametrize(("low", "high"), [(0.04, 0.05), (0.8, 0.05), (0.01, 0.9), (1e-3, 1e4)])
def test_axes_show_numbers_and_the_diagonal_joins_equal_errors(low: float, high: float) -> None:
    figure = drawn(result(view("mine/0000", low, high)))
    figure.draw_without_rendering()
    [axes] = figure.axes
    for axis, (first, last) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        ticks = [tick for tick in axis.get_major_ticks() if first <= tick.get_loc() <= last]
        assert len(ticks) >= 2
        assert all(tick.get_loc() == pytest.approx(float(tick.label1.get_text())) for tick in ticks)
    lines = [np.array(line.get_xydata()) for line in axes.lines]
    [ends] = [ends for ends in lines if len(ends) == 2 and np.all(ends[0] < ends[1])]
    assert ends.tolist() == [[limit, limit] for limit in axes.get_ylim()]


def test_legend_has_the_marks_of_the_tables() -> None:
    scores = [
        result(view("pier/0000", 0.5, 0.1), view("lattice/0000", 0.5, 0.1), method=name, declared=declared)
        for name, declared in (
            ("open", Declaration("rgb", uses_ground_truth=False)),
            ("silent", Declaration()),
            ("oracle", Declaration("rgb", uses_ground_truth=True)),
        )
    ]
    match = PublishedMatch("lattice", same_optics=False)
    figure = drawn(
        *(
            replace(score, tables={**score.tables, "lattice": replace(score.tables["lattice"], published=match)})
            for score in scores
        )
    )
    assert legend(figure)[:3] == ["open", "silent ?", "oracle ‡"]
    titles = {axes.get_title(): axes for axes in figure.axes}
    assert list(titles) == ["pier, 1 view", "lattice, 1 view, paper §"]
    assert [[text.get_text() for text in axes.texts] for axes in figure.axes] == [["†"], []]
    [mark] = titles["pier, 1 view"].texts
    assert mark.xy == points(titles["pier, 1 view"])["COLMAP+ArUco"] == (0.078, 0.083)  # type: ignore[attr-defined]
    notes = figure.texts[0].get_text()
    assert all(f"{mark}: " in notes for mark in "‡?†§")
    plain = drawn(scores[0], published=False)
    shown = [*legend(plain), plain.texts[0].get_text(), *(axes.get_title() for axes in plain.axes)]
    assert not any(mark in text for text in shown for mark in "‡?†§")
    assert [list(points(axes)) for axes in plain.axes] == [["open"], ["open"]]


def test_rows_without_errors_are_left_out_and_named(tmp_path: Path) -> None:
    empty = result(unpredicted_view("lattice/0000"), view("pile/0000", 0.5, 0.1), method="silent")
    infinite = result(overflowed_view("lattice/0000"), method="huge")
    table = infinite.tables["lattice"]
    table = replace(table, numbers={**table.numbers, "native.abs_rel": math.inf})
    infinite = replace(infinite, tables={"lattice": table})
    left_out = write_figure([empty, infinite], tmp_path / "a.svg", published=False)
    assert [note.partition(" has no errors of ")[0] for note in left_out] == ["silent", "huge"]
    lattice, pile = drawn(empty, infinite, published=False).axes
    assert not points(lattice)
    assert [text.get_text() for text in lattice.texts] == ["no errors"]
    assert points(pile) == {"silent": (0.5, 0.1)}
    assert not pile.texts


def test_title_names_the_split() -> None:
    [axes] = drawn(split_result()).axes
    assert axes.get_title() == "cages (test), 9 views"


@pytest.mark.parametrize(
    ("native", "scaled"), [(0.0, 0.0), (1e-300, 1e-9), (1e300, 5e-3), (3e-8, 1e9), (0.3, 0.3), (0.001, 10_000.0)]
)
def test_any_errors_lie_on_or_in_the_frame(native: float, scaled: float) -> None:
    figure = drawn(result(view("mine/0000", native, scaled), reference={}))
    [axes] = figure.axes
    [(x, y)] = points(axes).values()
    assert axes.get_xlim()[0] <= x <= axes.get_xlim()[1]
    assert axes.get_ylim()[0] <= y <= axes.get_ylim()[1]
    beyond = not (1e-3 <= native <= 1e4 and 1e-3 <= scaled <= 1e4)
    assert ("On the frame:" in figure.texts[0].get_text()) == beyond
    assert beyond or (x, y) == (native, scaled)


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 30])
@pytest.mark.parametrize("configs", [("lattice",), ("lattice", "pile", "pier"), tuple(f"c{i}" for i in range(5))])
def test_panels_legend_and_notes_do_not_overlap(count: int, configs: Sequence[str]) -> None:
    views = [view(f"{config}/0000", 0.5, 0.1) for config in configs]
    names = [f"{'W' * 90}{index}{'m' * 90}" if index % 3 == 1 else f"method-{index}" for index in range(count)]
    figure = drawn(*(result(*views, method=name) for name in names))
    assert figure.get_figwidth() == (3.5 if len(configs) == 1 else 7.15)
    figure.draw_without_rendering()
    [notes] = figure.texts
    boxes = [artist.get_window_extent() for artist in (notes, figure.legends[0])]
    boxes += [axes.get_tightbbox() for axes in figure.axes]  # type: ignore[misc]
    for box in boxes:
        assert 0 <= box.x0 < box.x1 <= figure.bbox.x1
        assert 0 <= box.y0 < box.y1 <= figure.bbox.y1
    for a, b in combinations(boxes, 2):
        assert a.x1 <= b.x0 or b.x1 <= a.x0 or a.y1 <= b.y0 or b.y1 <= a.y0, (a, b)


def test_markers_differ_in_shape_or_colour() -> None:
    count = 60
    figure = drawn(*(result(view("mine/0000", 0.5, 0.1), method=f"m{index:02}") for index in range(count)))
    markers = [line for line in figure.axes[0].lines if line.get_linestyle() == "None"]
    assert len({(line.get_marker(), line.get_color()) for line in markers}) == count


def test_hostile_names_are_texts(tmp_path: Path) -> None:
    names = (HOSTILE, "$\\frac{$", "_x", "あ")
    write_figure(
        [result(view("mine/0000", 0.5, 0.1), method=name) for name in names], tmp_path / "a.svg", published=False
    )
    svg = ElementTree.parse(tmp_path / "a.svg")
    assert not any(element.tag.rpartition("}")[2] in ("script", "image", "a") for element in svg.iter())
    shown = [str(element.text) for element in svg.iter("{http://www.w3.org/2000/svg}text")]
    assert any("<script" in name for name in shown)
    assert {*names[1:]} <= {*shown}


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["svg", "png", "pdf"])
def test_settings_of_the_user_do_not_count(suffix: str, tmp_path: Path) -> None:
    results = [result(view("mine/0000", 0.04, 0.03), method="near")]
    path = tmp_path / f"a.{suffix}"
    write_figure(results, path, published=False)
    expected = path.read_bytes()
    assert not re.search(rb"dc:date|CreationDate", expected)
    settings: Any = {"font.size": 20, "lines.linewidth": 5, "font.family": "serif", "savefig.dpi": 10}
    with matplotlib.rc_context({**settings, "savefig.bbox": "tight", "svg.hashsalt": None}):
        write_figure(results, path, published=False)
    assert path.read_bytes() == expected


def test_png_has_the_size_of_print_and_the_colours_of_points(tmp_path: Path) -> None:
    results = [
        result(view("mine/0000", 0.04, 0.03), method="near"),
        result(view("mine/0000", 0.8, 0.05), method="far"),
    ]
    write_figure(results, tmp_path / "a.png", published=True)
    image = Image.open(io.BytesIO((tmp_path / "a.png").read_bytes()))
    figure = drawn(*results)
    figure.draw_without_rendering()
    assert image.size == (1050, int(figure.get_figheight() * 300))
    assert image.info["dpi"] == pytest.approx((300, 300), abs=0.1)
    pixels = np.asarray(image.convert("RGB"))
    [axes] = figure.axes
    for place, colour in zip(points(axes).values(), ("0072b2", "d55e00"), strict=True):
        x, y = axes.transData.transform(place)
        assert bytes(pixels[-round(y), round(x)]).hex() == colour
    assert pixels[0, 0].tolist() == [255, 255, 255]


@pytest.mark.slow
def test_table_command_draws_archives(
    tiny_truth: dict[str, np.ndarray],
    tiny_root: Path,
    archive_of: Callable[..., Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    orbit = {row["view_id"]: row["left_depth"] for row in rdb.load(tiny_root, "lattice-orbit", streaming=True)}
    archives = [
        archive_of({view_id: 1.5 * depth for view_id, depth in {**tiny_truth, **orbit}.items()}, "a.zip"),
        archive_of({view_id: 0 * depth for view_id, depth in tiny_truth.items()}, "b.zip"),
    ]
    out = tmp_path / "new" / "figure.SVG"
    command = ["table", *map(str, archives), "--data", str(tiny_root), "--figure", str(out)]
    assert main(command) == 0
    assert "has no errors of lattice: left out of --figure" in capsys.readouterr().err
    before = out.read_bytes()
    shown = [str(text.text) for text in ElementTree.fromstring(before).iter("{http://www.w3.org/2000/svg}text")]
    assert {"lattice, 9 views", "lattice-orbit, 2 views", "reference: constant (for scaled)"} <= {*shown}
    assert sum(name.startswith("test (") and name.endswith(" ?") for name in shown) == 1
    assert main(command) == 0
    assert out.read_bytes() == before
    assert [path.name for path in out.parent.iterdir()] == [out.name]


def test_missing_extra_and_other_suffixes_are_refused_before_scoring(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ("table", "nowhere.zip", "--data", "nowhere", "--figure")
    for name in ("figure.gif", "figure", ".svg", "figure.svg.gz"):
        refused = run_in_process(main, *command, tmp_path / name)
        assert refused.returncode == 2
        assert "expected a name that ends in .svg, .png, .pdf" in refused.stderr
        assert "nowhere" not in refused.stderr
        with pytest.raises(InputError):
            check_figure(Path(name))
    monkeypatch.setattr("rebar_depth_bench.base.errors.find_spec", lambda _: None)
    refused = run_in_process(main, *command, tmp_path / "a.pdf")
    assert refused.returncode == 2
    assert "matplotlib; expected the plot extra: pip install '.[plot]'" in refused.stderr
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["folder.svg", "file/figure.svg"])
def test_unwritable_path_leaves_no_file(name: str, tmp_path: Path) -> None:
    (tmp_path / "folder.svg").mkdir()
    (tmp_path / "file").touch()
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError):
        write_figure([result(view("mine/0000", 0.5, 0.1))], tmp_path / name, published=True)
    assert main(["table", "nowhere.zip", "--data", "nowhere", "--figure", str(tmp_path / name)]) == 2
    assert sorted(tmp_path.rglob("*")) == before
