"""Figure of native against scaled AbsRel: content of the SVG, pixels of the PNG, layout, and the option."""

from __future__ import annotations

import io
import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import rebar_depth_bench as rdb
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.errors import InputError
from rebar_depth_bench.reporting.figure.content import figure_content
from rebar_depth_bench.reporting.figure.drawing import Drawing, Marker, Text, font, text_width
from rebar_depth_bench.reporting.figure.markers import archive_marker, published_marker
from rebar_depth_bench.reporting.figure.page import figure_drawing
from rebar_depth_bench.reporting.figure.png import png_bytes
from rebar_depth_bench.reporting.figure.svg import svg_bytes
from rebar_depth_bench.reporting.figure.write import check_figure_path, write_figure
from rebar_depth_bench.reporting.published import published_rows
from rebar_depth_bench.scoring.reference import NO_REFERENCE
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.scoring.table import PublishedMatch, ViewScore
from rebar_depth_bench.submission.declaration import Declaration
from tests.bench.reporting.results import (
    HOSTILE,
    REFERENCE,
    overflowed_view,
    result,
    scored_view,
    unpredicted_view,
)

ArchiveOf = Callable[..., Path]
SVG = "{http://www.w3.org/2000/svg}"


def view(view_id: str, native: float, scaled: float, coverage: float = 1.0) -> ViewScore:
    score = scored_view(view_id, native, coverage)
    assert score.scaled is not None
    return replace(score, scaled=replace(score.scaled, abs_rel=scaled))


def drawing_of(*results: Result, published: bool = True) -> Drawing:
    return figure_drawing(figure_content(results, published=published))


def svg_of(drawing: Drawing) -> ElementTree.Element:
    return ElementTree.fromstring(svg_bytes(drawing))


def places(svg: ElementTree.Element, role: str) -> dict[str, tuple[float, float]]:
    """Return the places of the markers of a role by their descriptions."""
    found = {}
    for group in svg.iter(f"{SVG}g"):
        if group.get("class") == role:
            x, y = str(group.get("transform")).removeprefix("translate(").removesuffix(")").split()
            found[str(group.findtext(f"{SVG}title"))] = (float(x), float(y))
    return found


def axes(svg: ElementTree.Element) -> tuple[Callable[[float], float], Callable[[float], float]]:
    """Return the places of native and scaled errors in a figure of one panel, from its tick labels alone."""
    ticks: dict[str, list[tuple[float, float]]] = {"middle": [], "end": []}
    for text in svg.iter(f"{SVG}text"):
        content = str(text.text)
        if content.replace(".", "").isdigit():
            anchor = str(text.get("text-anchor"))
            at = float(text.get("x", "")) if anchor == "middle" else float(text.get("y", "")) - 0.36 * 6.2
            ticks[anchor].append((math.log(float(content)), at))
    (x_slope, x_zero), (y_slope, y_zero) = (
        np.polyfit([value for value, _ in found], [at for _, at in found], 1) for found in ticks.values()
    )
    return lambda native: x_zero + x_slope * math.log(native), lambda scaled: y_zero + y_slope * math.log(scaled)


def test_points_and_references_are_where_the_tick_labels_say() -> None:
    near = result(view("lattice/0000", 0.04, 0.03), method="near")
    far = result(view("lattice/0000", 0.8, 0.05, coverage=0.9), method="far")
    svg = svg_of(drawing_of(near, far))
    x, y = axes(svg)
    archives, hollow, published = (places(svg, role) for role in ("archive", "hollow archive", "published"))
    assert archives["lattice, near: native 0.04, scaled 0.03"] == pytest.approx((x(0.04), y(0.03)), abs=0.02)
    assert hollow["lattice, far: native 0.8, scaled 0.05"] == pytest.approx((x(0.8), y(0.05)), abs=0.02)
    assert len(archives) == len(hollow) == 1
    rows = published_rows("lattice")
    assert len(published) == len(rows)
    for row, (description, place) in zip(rows, published.items(), strict=True):
        assert description.startswith(f"lattice, paper: {row.method}: native ")
        assert place == pytest.approx((x(float(row.abs_rel)), y(float(row.abs_rel_scaled))), abs=0.02)
    constants = places(svg, "reference constant")
    assert list(constants) == ["lattice, constant: scaled 0.0571", "lattice, constant, far: scaled 0.0529"]
    (_, constant), (_, of_far) = constants.values()
    [(one_pixel, _)] = places(svg, "reference one-pixel").values()
    assert REFERENCE.constant.abs_rel is not None
    assert REFERENCE.one_pixel.abs_rel is not None
    assert constant == pytest.approx(y(REFERENCE.constant.abs_rel), abs=0.02)
    assert of_far == pytest.approx(y(0.0529), abs=0.02)
    assert one_pixel == pytest.approx(x(REFERENCE.one_pixel.abs_rel), abs=0.02)
    legend = list(places(svg, "legend"))
    assert legend[:2] == ["near", "far"]
    assert legend[2:8] == [f"paper: {row.method}" for row in rows]
    assert [name.partition(" (")[0] for name in legend[8:]] == [
        "reference: constant",
        "reference: one pixel",
        "native = scaled",
    ]


def test_diagonal_joins_equal_errors() -> None:
    svg = svg_of(drawing_of(result(view("mine/0000", 0.8, 0.05))))
    x, y = axes(svg)
    lines = [
        line.get("d", "")[1:].split("L") for line in svg.findall(f"{SVG}path") if line.get("stroke-dasharray")
    ]
    [(start, end)] = [[tuple(map(float, point.split())) for point in line] for line in lines]
    for at_x, at_y in (start, end):
        native = math.exp(np.interp(at_x, [x(1e-4), x(1e4)], [math.log(1e-4), math.log(1e4)]))
        assert at_y == pytest.approx(y(native), abs=0.05)
    assert start[1] - end[1] > 100


def test_marks_of_the_tables() -> None:
    scores = [
        result(view("pier/0000", 0.5, 0.1), view("lattice/0000", 0.5, 0.1), method=name, declared=declared)
        for name, declared in (
            ("open", Declaration("rgb", uses_ground_truth=False)),
            ("silent", Declaration()),
            ("oracle", Declaration("rgb", uses_ground_truth=True)),
        )
    ]
    other = [
        replace(
            score,
            tables={
                **score.tables,
                "lattice": replace(
                    score.tables["lattice"], published=PublishedMatch("lattice", same_optics=False)
                ),
            },
        )
        for score in scores
    ]
    svg = svg_of(drawing_of(*other))
    assert list(places(svg, "legend"))[:3] == ["open", "silent ?", "oracle ‡"]
    published = list(places(svg, "published"))
    assert all(" §: native" in name for name in published if name.startswith("lattice"))
    assert [name for name in published if name.startswith("pier") and "†" in name] == [
        "pier, paper: COLMAP+ArUco †: native 0.078, scaled 0.083"
    ]
    texts = [str(text.text) for text in svg.iter(f"{SVG}text")]
    assert "lattice, 1 view, paper §" in texts
    assert "pier, 1 view" in texts
    assert texts.count("†") == 1
    notes = " ".join(texts)
    assert all(f"{mark}: " in notes for mark in "‡?†§")
    plain = svg_of(drawing_of(scores[0], published=False))
    assert not places(plain, "published")
    assert not any(mark in str(text.text) for text in plain.iter(f"{SVG}text") for mark in "‡?†§")


def test_rows_without_errors_are_left_out_and_named() -> None:
    empty = result(unpredicted_view("lattice/0000"), view("pile/0000", 0.5, 0.1), method="silent")
    infinite = result(overflowed_view("lattice/0000"), method="huge")
    assert infinite.tables["lattice"].native is not None
    native = replace(infinite.tables["lattice"].native, abs_rel=math.inf)
    infinite = replace(infinite, tables={"lattice": replace(infinite.tables["lattice"], native=native)})
    content = figure_content([empty, infinite], published=False)
    assert [note.partition(" has no errors of ")[0] for note in content.left_out] == ["silent", "huge"]
    svg = svg_of(figure_drawing(content))
    assert list(places(svg, "archive")) == ["pile, silent: native 0.5, scaled 0.1"]
    assert [str(text.text) for text in svg.iter(f"{SVG}text")].count("no errors") == 1


@pytest.mark.parametrize(
    ("native", "scaled"), [(0.0, 0.0), (1e-300, 1e-9), (1e300, 5e-3), (3e-8, 1e9), (0.3, 0.3), (0.001, 10_000.0)]
)
def test_any_errors_lie_on_or_in_the_frame(native: float, scaled: float) -> None:
    score = result(view("mine/0000", native, scaled), reference=NO_REFERENCE)
    drawing = drawing_of(score)
    [((x, y))] = places(svg_of(drawing), "archive").values()
    assert 30 < x < drawing.width
    assert 10 < y < drawing.height
    beyond = not (1e-3 <= native <= 1e4 and 1e-3 <= scaled <= 1e4)
    assert (
        any("On the frame:" in element.content for element in drawing.elements if isinstance(element, Text))
        == beyond
    )


def text_box(text: Text) -> tuple[float, float, float, float]:
    """Return the left, top, right and lower end of a text."""
    width = text_width(text.content, text.size)
    before = {"start": 0.0, "middle": width / 2, "end": width}[text.anchor]
    x, y = text.at
    if text.turned:
        return x - 0.75 * text.size, y - width + before, x + 0.2 * text.size, y + before
    return x - before, y - 0.75 * text.size, x - before + width, y + 0.2 * text.size


@pytest.mark.parametrize("count", [1, 2, 7, pytest.param(30, marks=pytest.mark.slow)])
@pytest.mark.parametrize("configs", [("lattice",), ("lattice", "pile", "pier"), tuple(f"c{i}" for i in range(5))])
def test_texts_overlap_neither_each_other_nor_the_legend(count: int, configs: Sequence[str]) -> None:
    rng = np.random.default_rng(count)
    results = [
        result(
            *(view(f"{config}/0000", *(10 ** rng.uniform(-3, 1, 2))) for config in configs),
            method=f"{'W' * 90}{index}{'m' * 90}" if index % 3 == 1 else f"method-{index}",
        )
        for index in range(count)
    ]
    drawing = drawing_of(*results)
    boxes = [text_box(element) for element in drawing.elements if isinstance(element, Text)]
    for left, top, right, bottom in boxes:
        assert 0 <= left < right <= drawing.width
        assert 0 <= top < bottom <= drawing.height
    for a, b in combinations(boxes, 2):
        assert a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1], (a, b)
    markers = [element for element in drawing.elements if isinstance(element, Marker)]
    lowest_point = max(marker.at[1] for marker in markers if marker.role != "legend")
    assert all(marker.at[1] > lowest_point + 25 for marker in markers if marker.role == "legend")


def test_markers_differ_without_colour() -> None:
    def shape(paths: Sequence[object]) -> str:
        return repr([(path.points, path.fill == "#ffffff") for path in paths])  # type: ignore[attr-defined]

    filled = {shape(archive_marker(index, 1000, hollow=False)) for index in range(24)}
    hollow = {shape(archive_marker(index, 1000, hollow=True)) for index in range(24)}
    strokes = {shape(published_marker(index)) for index in range(6)}
    assert len(filled | hollow | strokes) == 54


def test_hostile_name_is_text_in_the_svg() -> None:
    svg = svg_of(drawing_of(result(view("mine/0000", 0.5, 0.1), method=HOSTILE)))
    assert {element.tag.removeprefix(SVG) for element in svg.iter()} == {
        *("svg", "title", "desc", "rect", "g", "path", "text")
    }
    assert any("<script" in name for name in places(svg, "legend"))


def test_font_has_the_marks_of_figures() -> None:
    def drawn(character: str) -> bytes:
        return bytes(font(40).getmask(character))

    assert all(drawn(character) != drawn("\U0010ffff") for character in "†‡§?…–éßΩЖ\N{REPLACEMENT CHARACTER}")


@pytest.mark.slow
def test_png_has_the_size_of_print_and_the_points_of_the_svg() -> None:
    drawing = drawing_of(
        result(view("mine/0000", 0.04, 0.03), method="near"), result(view("mine/0000", 0.8, 0.05), method="far")
    )
    content = png_bytes(drawing)
    assert content == png_bytes(drawing)
    image = Image.open(io.BytesIO(content))
    assert image.size == (1050, math.ceil(drawing.height * 300 / 72))
    assert image.info["dpi"] == pytest.approx((300, 300), abs=0.1)
    assert set(image.info) == {"dpi"}
    pixels = np.asarray(image.convert("RGB"))
    for (x, y), colour in zip(places(svg_of(drawing), "archive").values(), ("0072b2", "d55e00"), strict=True):
        assert bytes(pixels[round(y * 300 / 72), round(x * 300 / 72)]).hex() == colour
    assert pixels[0, 0].tolist() == [255, 255, 255]


def test_table_command_draws_archives(
    tiny_truth: dict[str, np.ndarray],
    tiny_root: Path,
    archive_of: ArchiveOf,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    orbit = {row["view_id"]: row["left_depth"] for row in rdb.load(tiny_root, "lattice-orbit")}
    archives = [
        archive_of({view_id: 1.5 * depth for view_id, depth in {**tiny_truth, **orbit}.items()}, "a.zip"),
        archive_of({view_id: 0 * depth for view_id, depth in tiny_truth.items()}, "b.zip"),
    ]
    out = tmp_path / "new" / "figure.SVG"
    command = ["table", *map(str, archives), "--data", str(tiny_root), "--figure", str(out)]
    assert main(command) == 0
    assert "has no errors of lattice: left out of --figure" in capsys.readouterr().err
    before = out.read_bytes()
    points = places(ElementTree.fromstring(before), "archive")
    assert [name.partition(",")[0] for name in points] == ["lattice", "lattice-orbit"]
    assert all(" ?: native 0.5, scaled " in name for name in points)
    references = places(ElementTree.fromstring(before), "reference constant")
    expected = rdb.score(archives[0], tiny_root).tables["lattice"].reference.constant.abs_rel
    assert next(iter(references)) == f"lattice, constant: scaled {expected:.4g}"
    assert main(command) == 0
    assert out.read_bytes() == before
    assert [path.name for path in out.parent.iterdir()] == [out.name]


@pytest.mark.parametrize("name", ["figure.pdf", "figure", ".svg", "figure.svg.gz"])
def test_other_suffixes_are_refused_before_scoring(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["table", "nowhere.zip", "--data", "nowhere", "--figure", str(tmp_path / name)]
    assert main(command) == 2
    stderr = capsys.readouterr().err
    assert "expected a name that ends in .svg or .png" in stderr
    assert "nowhere" not in stderr
    assert not any(tmp_path.iterdir())
    with pytest.raises(InputError):
        check_figure_path(Path(name))


@pytest.mark.parametrize("name", ["folder.svg", "file/figure.svg"])
def test_unwritable_path_leaves_no_file(name: str, tmp_path: Path) -> None:
    (tmp_path / "folder.svg").mkdir()
    (tmp_path / "file").touch()
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError):
        write_figure([result(view("mine/0000", 0.5, 0.1))], tmp_path / name, published=True)
    assert main(["table", "nowhere.zip", "--data", "nowhere", "--figure", str(tmp_path / name)]) == 2
    assert sorted(tmp_path.rglob("*")) == before
