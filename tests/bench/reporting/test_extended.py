"""Extended measures in report and terminal: golden texts, formatting of numbers, and crossings of a dataset."""

from __future__ import annotations

import dataclasses
import io
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

import rebar_depth_bench as rdb
from rebar_depth_bench.data.files import file_sha256
from rebar_depth_bench.extended.estimates import (
    ExtendedResult,
    MeasureEstimate,
    ViewSamples,
    tabulate_extended,
    view_measures,
)
from rebar_depth_bench.extended.families import measures_by_alignment
from rebar_depth_bench.extended.fits import MISS_MM
from rebar_depth_bench.extended.measures import SCALED, Measure, Statistic
from rebar_depth_bench.reporting.extended_tables import print_extended
from rebar_depth_bench.reporting.html.extended import estimate_cell
from rebar_depth_bench.reporting.html.page import render_report
from rebar_depth_bench.scoring.bootstrap import resample
from tests.bench.reporting.pages import Page, without_embedded
from tests.bench.reporting.results import HOSTILE, result, scored_view
from tests.mat_dataset import CONFIG, VIEWS, write_mat_dataset

INDICES = range(0, 800, 100)
"""Indices of the views, so far apart that each is a block."""
LEVELS = {
    "bar_found": 0.875,
    "spacing_error_mm": -1.25,
    "spacing_judged_mm": 4.0,
    "cover_judged_mm": MISS_MM,
    "depth_offset_judged_mm": 12.5,
    "silog": 0.0625,
    "boundary_f1": 0.4375,
    "tie_judged_mm": 3.5,
    "single_bar_share": 0.125,
    "single_bar_abs_rel": 0.0317,
    "single_bar_views_abs_rel": 0.0517,
    **{f"cloud_{kind}_{t}mm": 0.1 + t / 40 for kind in ("accuracy", "completeness", "f") for t in (5, 10)},
}
"""Mean of each view's samples by name; scaled samples are half of it."""


def make_view(index: int, levels: dict[str, float]) -> ViewSamples:
    rng = np.random.default_rng(index)
    samples = {}
    for alignment, measures in measures_by_alignment().items():
        factor = 0.5 if alignment == SCALED else 1.0
        samples_by_name: dict[str, np.ndarray] = {measure.sample: np.empty(0) for measure in measures}
        for name in [name for name in samples_by_name if name in levels]:  # In order, for the random numbers.
            level = levels[name]
            spread = 0.0 if level == MISS_MM else 0.01 * level
            samples_by_name[name] = factor * (level + spread * rng.uniform(-1, 1, 4))
        samples[alignment] = samples_by_name
    return samples


def make_extended(*configs: str, levels: dict[str, float] | None = None, views: int = 8) -> ExtendedResult:
    measures = measures_by_alignment()
    of_config = {index: make_view(index, LEVELS if levels is None else levels) for index in INDICES[:views]}
    table = tabulate_extended(list(of_config.values()), resample(INDICES[:views]), measures)
    numbers = {
        f"{config}/{index:04d}": view_measures(one, measures)
        for config in configs
        for index, one in of_config.items()
    }
    return ExtendedResult(measures, dict.fromkeys(configs, table), numbers)


def section_of(extended: ExtendedResult, *configs: str) -> str:
    """Return the section of extended measures in the report of configs."""
    views = [scored_view(f"{config}/{index:04d}") for config in configs for index in INDICES]
    page = render_report(dataclasses.replace(result(*views), extended=extended), [])
    return page[page.index('<section aria-labelledby="extended"') :].partition("</section>")[0]


@pytest.fixture(scope="module")
def section() -> str:
    return section_of(make_extended("lattice"), "lattice")


def test_section_and_terminal_tables_are_the_golden_texts(
    section: str, check_golden: Callable[[str, str], None]
) -> None:
    check_golden("extended.html", without_embedded(section))
    for width in (80, 100):
        console = Console(width=width, file=io.StringIO(), record=True)
        print_extended(make_extended("lattice"), console)
        text = console.export_text()
        assert max(map(len, text.splitlines())) <= width
        check_golden(f"extended-{width}.txt", text)


def test_measures_without_values_are_explained() -> None:
    none = section_of(make_extended("lattice", levels={**LEVELS, "single_bar_share": 0.0}), "lattice")
    assert "every scored pixel has a second bar within one pixel" in none
    nothing = section_of(make_extended("lattice", levels={}), "lattice")
    assert "No bar of these views is straight, long and wide enough to be judged." in nothing
    assert "<svg" not in nothing
    few = section_of(make_extended("lattice", views=2), "lattice")
    assert 'class="interval"' not in few
    assert "slim interval" not in few


def test_hostile_name_of_a_config_is_escaped() -> None:
    name = HOSTILE.replace("/", "")
    page = Page(f"{section_of(make_extended('lattice', name), 'lattice', name)}</section>")
    assert page.count("script") == 0
    assert "\x1b" not in page.text
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(ids) == len(set(ids))


def make_measure(unit: str, statistic: Statistic = "mean") -> Measure:
    return Measure("m", "M", unit, "", "for this test", "s", statistic)


@pytest.mark.parametrize(
    ("estimate", "measure", "text", "interval"),
    [
        (MeasureEstimate(0.1234, (0.1, 0.2), 9), make_measure("%"), "12.3", "10.0 – 20.0"),
        (MeasureEstimate(-1.005, (-2.0, 0.5), 9), make_measure("mm"), "−1.00", "−2.00 to 0.50"),
        (MeasureEstimate(1e-9, None, 9), make_measure(""), "1.0e−09", ""),
        (MeasureEstimate(math.inf, (1.0, math.inf), 9), make_measure("cm"), "–", ""),
        (MeasureEstimate(None, None, 0), make_measure("mm"), "–", ""),
    ],
)
def test_estimate_cell_formats_by_unit(
    estimate: MeasureEstimate, measure: Measure, text: str, interval: str
) -> None:
    cell = estimate_cell(estimate, measure)
    assert (cell.text, cell.interval) == (text, interval)


@dataclasses.dataclass(frozen=True)
class Mat:
    """Dataset of a mat, with the depth of its views by id."""

    root: Path
    depths_m: dict[str, np.ndarray]

    def archive(self, shift_mm: dict[int, float], config: str = CONFIG) -> Path:
        """Write the depth of a config's test views, shifted by millimetres by the index of the view."""
        path = self.root.parent / "a.zip"
        with rdb.SubmissionWriter(path, method="shifted") as writer:
            for view_id, depth_m in self.depths_m.items():
                if view_id.startswith(config) and "train" not in view_id:
                    shifted_m = depth_m + np.float32(shift_mm.get(int(view_id[-4:]), 0.0) / 1000)
                    writer.add(view_id, np.where(depth_m > 0, shifted_m, 0.0).astype(np.float32))
        return path


@pytest.fixture(scope="module")
def mat(tmp_path_factory: pytest.TempPathFactory) -> Mat:
    root = tmp_path_factory.mktemp("mat") / "dataset"
    root.mkdir()
    return Mat(root, write_mat_dataset(root))


def extended(archive: Path, root: Path) -> ExtendedResult:
    """Return the extended measures of an archive."""
    found = rdb.score(archive, root, extended=True).extended
    assert found is not None
    return found


@pytest.mark.slow
def test_measures_of_a_config_pool_its_views(mat: Mat) -> None:
    archive = mat.archive({0: 3.0, 1: 7.0, 2: 60.0})
    found = extended(archive, mat.root)
    numbers = found.tables[CONFIG].numbers["native"]
    assert numbers["crossings_located"].value == pytest.approx(5 / VIEWS)  # A bar 60 mm away is none of ours.
    assert [numbers[f"tie_within_{limit}mm"].value for limit in (2, 5)] == pytest.approx([3 / 6, 4 / 6])
    assert numbers["tie_p95_mm"].value == 100.0
    assert numbers["tie_along_bias_mm"].value == pytest.approx((3 + 7) / 5, abs=0.2)
    assert numbers["tie_within_5mm"].samples == 4 * VIEWS
    console = Console(record=True, width=120, file=io.StringIO())
    print_extended(found, console)
    text = " ".join(console.export_text().split())
    assert "tie point: median, mm" in text
    content = found.to_dict()
    assert content["crossings"] == {
        "file": "crossings.parquet",
        "sha256": file_sha256(mat.root / "crossings.parquet"),
    }


@pytest.mark.slow
def test_older_folder_is_stamped_with_its_bars(mat: Mat, tmp_path: Path) -> None:
    older = tmp_path / "older"
    older.mkdir()
    write_mat_dataset(older, with_crossings=False)
    archive = mat.archive({})
    found, expected = extended(archive, older), extended(archive, mat.root)
    assert found.crossings is not None
    assert (found.crossings.file, found.crossings.sha256) == ("bars.parquet", file_sha256(older / "bars.parquet"))
    assert found.to_dict()["tables"] == expected.to_dict()["tables"]


@pytest.mark.slow
def test_report_shows_the_table_of_crossings(mat: Mat, tmp_path: Path) -> None:
    archive = mat.archive({0: 3.0})
    scored = rdb.score(archive, mat.root, extended=True)
    scored.to_html(tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    shown = page[page.index('<h2 id="crossings">') :].partition("</section>")[0]
    assert "crossings.parquet, SHA-256" in shown
    assert "tie point: median" in shown
    assert "<script" not in shown


@pytest.mark.slow
def test_config_of_several_scenes_has_crossings_of_each(mat: Mat) -> None:
    numbers = extended(mat.archive({1: 60.0}, "cages"), mat.root).tables["cages"].numbers["native"]
    assert numbers["tie_within_5mm"].samples == 16  # Two scenes of two views in the split test.
    assert numbers["crossings_located"].value == 0.5
