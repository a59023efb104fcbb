"""Extended-measures section of the HTML report: contents, number formatting and determinism."""

from __future__ import annotations

import dataclasses
import math
import re

import numpy as np
import pytest

from rebar_depth_bench.extended.fits import MISS_MM
from rebar_depth_bench.extended.inspection import CAPABILITY_MEASURES, PROFILES
from rebar_depth_bench.extended.measures import NATIVE, SCALED, Measure, Statistic
from rebar_depth_bench.extended.registry import MEASURE_FAMILIES, measures_by_alignment
from rebar_depth_bench.extended.result import (
    ExtendedResult,
    MeasureEstimate,
    ViewSamples,
    tabulate_extended,
    view_numbers,
)
from rebar_depth_bench.reporting.html.extended import (
    MAIN_INSPECTION_MEASURES,
    estimate_cell,
    extended_config,
    measure_definitions,
)
from rebar_depth_bench.reporting.html.page import render_report
from rebar_depth_bench.scoring.bootstrap import resample
from rebar_depth_bench.scoring.result import Result
from tests.bench.reporting.pages import Page
from tests.bench.reporting.results import HOSTILE, result, scored_view
from tests.bench.reporting.results import shown as images_of

VIEWS = 8
INDICES = [100 * index for index in range(VIEWS)]

LEVELS = {
    "bar_found": 0.875,
    "spacing_error_mm": -1.25,
    "spacing_judged_mm": 4.0,
    "layer_judged_mm": MISS_MM,
    "cover_judged_mm": 12.5,
    "pass_gb50204_spacing": 0.625,
    "scale": 0.97,
    "boundary_f1": 0.4375,
    "layer_confusion": 0.0625,
    "interior_abs_rel": 0.0517,
    "single_bar_share": 0.125,
    "single_bar_abs_rel": 0.0317,
    "single_bar_views_abs_rel": 0.0517,
    **{
        f"cloud_{kind}_{t}mm": 0.1 + t / 40
        for kind in ("accuracy", "completeness", "f")
        for t in (1, 2, 5, 10, 20)
    },
    **{f"abs_rel_at_{name}": level for name, level in (("0.3-0.4m", 0.02), ("0.4-0.5m", 0.04), ("8-12px", 0.03))},
    **{f"scale_at_{name}": level for name, level in (("0.3-0.4m", 0.99), ("0.4-0.5m", 1.01), ("8-12px", 0.98))},
}
"""Mean of each view's samples by name; scaled samples are half of it."""


def make_view(index: int, levels: dict[str, float]) -> ViewSamples:
    rng = np.random.default_rng(index)
    samples = {}
    for alignment, measures in measures_by_alignment().items():
        factor = 0.5 if alignment == SCALED else 1.0
        samples_by_name: dict[str, np.ndarray] = {measure.sample: np.empty(0) for measure in measures}
        for name in samples_by_name.keys() & levels.keys():
            level = levels[name]
            spread = 0.0 if level == MISS_MM else 0.01 * level
            samples_by_name[name] = factor * (level + spread * rng.uniform(-1, 1, 4))
        samples[alignment] = samples_by_name
    return samples


def make_extended(*configs: str, levels: dict[str, float] | None = None, views: int = VIEWS) -> ExtendedResult:
    measures = measures_by_alignment()
    of_config = {index: make_view(index, LEVELS if levels is None else levels) for index in INDICES[:views]}
    table = tabulate_extended(list(of_config.values()), resample(INDICES[:views]), measures)
    numbers = {
        f"{config}/{index:04d}": view_numbers(one, measures)
        for config in configs
        for index, one in of_config.items()
    }
    return ExtendedResult(measures, dict.fromkeys(configs, table), numbers)


def result_with_extended(extended: ExtendedResult | None, *configs: str) -> Result:
    views = [scored_view(f"{config}/{index:04d}") for config in configs for index in INDICES]
    return dataclasses.replace(result(*views), extended=extended)


@pytest.fixture(scope="module")
def lattice() -> ExtendedResult:
    return make_extended("lattice")


@pytest.fixture(scope="module")
def rendered(lattice: ExtendedResult) -> str:
    return render_report(result_with_extended(lattice, "lattice"), [])


def extended_section_html(page: str) -> str:
    match = re.search(r'<section aria-labelledby="extended".*?</section>', page, re.DOTALL)
    assert match
    return match[0]


def table_row_cells(page: str, label: str, name: str) -> list[str]:
    """Return the cells of the row ``name`` of the table ``label``, value and interval joined by a space."""
    table = re.search(rf'<table[^>]* aria-label="{re.escape(label)}">.*?</table>', page, re.DOTALL)
    assert table, label
    rows = [
        [Page(cell).text.strip() for cell in re.findall(r"<t[hd].*?</t[hd]>", row)]
        for row in re.findall(r"<tr>.*?</tr>", table[0], re.DOTALL)
    ]
    return next(cells[1:] for cells in rows if cells[0] == name)


def test_no_section_without_extended_measures() -> None:
    page = render_report(result_with_extended(None, "lattice"), [])
    assert 'aria-labelledby="extended"' not in page
    assert "Extended measures" not in page


def remove_details(section: str) -> str:
    inner = re.sub(r'<details class="meanings">.*?</details>', "", section, flags=re.DOTALL)
    return re.sub(r"<details>.*?</details>", "", inner, flags=re.DOTALL)


def test_inspection_table_is_open_with_native_and_scaled(rendered: str, lattice: ExtendedResult) -> None:
    opened, label = remove_details(extended_section_html(rendered)), "lattice: Inspection, bar by bar"
    cells = table_row_cells(opened, label, "bars found %\xa0↑")
    assert [cell[:3] for cell in cells] == ["87.", "43.", "32"]
    numbers = lattice.tables["lattice"].numbers
    spacing = table_row_cells(opened, label, "bar spacing: bias mm")
    for alignment, cell in zip((NATIVE, SCALED), spacing, strict=False):
        estimate = numbers[alignment]["spacing_bias_mm"]
        assert estimate.value is not None
        assert estimate.interval is not None
        value, low, high = (f"{number:.2f}".replace("-", "−") for number in (estimate.value, *estimate.interval))
        assert cell == f"{value} {low} to {high}", alignment
    assert set(MAIN_INSPECTION_MEASURES) < {measure.name for measure in MEASURE_FAMILIES["inspection"].measures}


def test_missed_bars_are_shown_as_missed_not_as_length(rendered: str) -> None:
    layer = table_row_cells(rendered, "lattice: Inspection, bar by bar", "layer distance: p95 error mm\xa0↓")
    assert layer == ["missed", "50.00 50.00 – 50.00", "32"]
    assert "missed: not found, counted as 100 mm." in Page(rendered).text


def test_tolerance_rows_have_pass_rate_capability_source(rendered: str, lattice: ExtendedResult) -> None:
    label = "lattice: tolerances of inspection"
    limit, *passes_and_capabilities = table_row_cells(rendered, label, "GB 50204 bar spacing")
    assert limit == "10"
    assert [cell[:3] for cell in passes_and_capabilities[:2]] == ["62.", "31."]
    numbers = lattice.tables["lattice"].numbers
    for alignment, cell, expected in zip((NATIVE, SCALED), passes_and_capabilities[2:], (2.5, 5.0), strict=True):
        estimate = numbers[alignment]["capability_gb50204_spacing"]
        assert estimate.value == pytest.approx(expected, rel=0.02)
        assert estimate.interval is not None
        assert cell == f"{estimate.value:.2f} {estimate.interval[0]:.2f} – {estimate.interval[1]:.2f}"
    assert table_row_cells(rendered, label, "GB 50204 distance of layers")[3:] == ["n/a", "0.10 0.10 – 0.10"]
    text = Page(rendered).text
    assert "n/a: 5 % or more were not found" in text
    assert all(profile.source in text for profile in PROFILES)
    assert "ACI" not in extended_section_html(rendered)


def test_every_heading_states_its_alignment(rendered: str) -> None:
    section = extended_section_html(rendered)
    heads = re.findall(r'<th [^>]*class="alignment ([a-z]+)[^"]*"[^>]*>(.*?)</th>', section, re.DOTALL)
    asides = {
        "native": "no alignment",
        "scaled": "oracle median scale per view",
        "once": r"own alignment, see the row|independent of scale",
    }
    assert {kind for kind, _ in heads} == set(asides)
    for kind, content in heads:
        assert re.search(f'{kind}<span class="unit">({asides[kind]})</span>', content), content


def test_families_are_collapsed_and_definitions_listed(rendered: str) -> None:
    section = extended_section_html(rendered)
    assert "<details open" not in section
    for key in ("full_mask", "single_bar", "boundary", "layers", "clouds", "alignment"):
        assert f"<summary>{MEASURE_FAMILIES[key].title} <" in section
    page = Page(rendered)
    for measure in (*MEASURE_FAMILIES["layers"].measures, *MEASURE_FAMILIES["alignment"].measures):
        assert re.sub(r"\s+", " ", measure.definition) in page.text, measure.name
    assert "title=" not in section, "reached by touch and keyboard, not by hovering"


def test_single_bar_interior_stands_beside_the_whole_one(rendered: str) -> None:
    match = re.search(r"<b>Single-bar interior.</b> (.*?)</p>", rendered)
    assert match is not None
    numbers = [float(number) for number in re.findall(r"\d+(?:\.\d+)?", match[1])]
    assert numbers == pytest.approx([12.5, 0.0317, 0.0517, 0.0159, 0.0259], rel=0.02)
    none = {**LEVELS, "single_bar_share": 0.0}
    page = render_report(result_with_extended(make_extended("lattice", levels=none), "lattice"), [])
    assert "every scored pixel has a second bar within one pixel" in page


def test_cloud_measures_form_one_row_per_tolerance(rendered: str) -> None:
    for tolerance_mm in (1, 2, 5, 10, 20):
        shown = table_row_cells(rendered, "lattice: Point clouds", str(tolerance_mm))
        native = 100 * (0.1 + tolerance_mm / 40)
        values = [float(cell.split()[0]) for cell in shown]
        assert values == pytest.approx([native] * 3 + [native / 2] * 3, abs=1.0)
    assert rendered.count('aria-label="lattice: Point clouds"') == 2
    assert re.search(r'<table class="sortable" aria-label="lattice: Point clouds"', rendered)


def test_charts_show_only_bins_with_values(rendered: str) -> None:
    section = extended_section_html(rendered)
    charts = re.findall(r"<svg.*?</svg>", section, re.DOTALL)
    assert len(charts) == 2
    native = re.search(r"0\.3 to 0\.4 m: AbsRel native ([0-9.]+),", charts[0])
    assert native is not None
    assert float(native[1]) == pytest.approx(0.02, rel=0.05)
    assert charts[0].count("<circle") == 2 * 3
    assert charts[1].count("<circle") == 1 * 3
    assert all(f">{edge}</text>" in charts[0] for edge in ("0.3", "0.4", "0.5"))
    assert ">0.2</text>" not in charts[0].replace("0.02", "")


def test_empty_measures_and_too_few_views() -> None:
    nothing = render_report(result_with_extended(make_extended("lattice", levels={}), "lattice"), [])
    assert "No bar of these views is straight, long and wide enough to be judged." in nothing
    assert "<svg" not in extended_section_html(nothing)
    few = make_extended("lattice", views=2)
    section = extended_section_html(render_report(result_with_extended(few, "lattice"), []))
    assert 'class="interval"' not in section
    assert "slim interval" not in section


def test_page_nests_and_escapes_hostile_config_name() -> None:
    name = HOSTILE.replace("/", "")
    page = Page(
        render_report(result_with_extended(make_extended("lattice", name), "lattice", name), [images_of()])
    )
    assert len(page.attributes_of("script")) == 1
    assert "\x1b" not in page.text
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(ids) == len(set(ids))


def test_rendering_is_deterministic(lattice: ExtendedResult) -> None:
    first, second = (
        render_report(result_with_extended(extended, "lattice"), [])
        for extended in (lattice, make_extended("lattice"))
    )
    assert first == second


def test_section_keeps_config_order() -> None:
    tables = make_extended("pile", "lattice").tables
    configs = [extended_config(name, table) for name, table in tables.items()]
    assert [config.name for config in configs] == ["pile", "lattice"]
    assert all(len(config.tolerances) == len(CAPABILITY_MEASURES) for config in configs)


def make_measure(unit: str, statistic: Statistic = "mean") -> Measure:
    return Measure("m", "M", unit, "", "for this test", "s", statistic)


@pytest.mark.parametrize(
    ("estimate", "unit", "text", "interval"),
    [
        (MeasureEstimate(0.1234, (0.1, 0.2), 9), "%", "12.3", "10.0 – 20.0"),
        (MeasureEstimate(-1.005, (-2.0, 0.5), 9), "mm", "−1.00", "−2.00 to 0.50"),
        (MeasureEstimate(1e-9, None, 9), "", "1.0e−09", ""),
        (MeasureEstimate(math.inf, (1.0, math.inf), 9), "cm", "–", ""),
        (MeasureEstimate(None, None, 0), "mm", "–", ""),
    ],
)
def test_estimate_cell_formats_by_unit(estimate: MeasureEstimate, unit: str, text: str, interval: str) -> None:
    cell = estimate_cell(estimate, make_measure(unit))
    assert (cell.text, cell.interval) == (text, interval)


def test_capability_is_formatted_as_ratio() -> None:
    texts = [
        estimate_cell(estimate, CAPABILITY_MEASURES[0]).text
        for estimate in (
            MeasureEstimate(2.5, None, 9),
            MeasureEstimate(math.inf, None, 9),
            MeasureEstimate(None, None, 9),
            MeasureEstimate(None, None, 0),
        )
    ]
    assert texts == ["2.50", "∞", "n/a", "–"]


def test_definitions_differing_only_in_step_are_merged() -> None:
    definitions = dict(measure_definitions(MEASURE_FAMILIES["clouds"].measures))
    assert list(definitions) == ["Cloud accuracy, N mm", "Cloud completeness, N mm", "Cloud F-score, N mm"]
    assert definitions["Cloud accuracy, N mm"].endswith("; N: 1, 2, 5, 10, 20")
    boundary = dict(measure_definitions(MEASURE_FAMILIES["boundary"].measures))
    assert "at t = N % (" in boundary["Boundary F1, steps over N %"]
    assert "max/min > 1 + t" in boundary["Boundary F1, steps over N %"], "what is no step stays"
    assert "t = 1, 2, 5, 10, 20 %" in boundary["Boundary F1"]
    similar_measures = [
        dataclasses.replace(make_measure("%"), title=f"In {t} mm", definition=f"{t} mm, 24 px off") for t in (3, 5)
    ]
    assert [definition for _, definition in measure_definitions(similar_measures)] == ["N mm, 24 px off; N: 3, 5"]
    assert list(dict(measure_definitions(MEASURE_FAMILIES["profile"].measures))) == [
        "Scale s at N m",
        "AbsRel at N m",
        "Scale s on bars of N px",
        "AbsRel on bars of N px",
        "Single-bar share at N m",
        "AbsRel, single-bar, at N m",
    ]
