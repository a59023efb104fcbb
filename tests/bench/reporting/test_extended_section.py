"""The extended measures' part of the page: what it shows, how it is spelled, and that it stands by itself."""

from __future__ import annotations

import dataclasses
import math
import re

import numpy as np
import pytest

from rebar_depth_bench.extended.evaluate import FAMILIES, NATIVE, SCALED, measures_by_alignment
from rebar_depth_bench.extended.inspection.measures import MEASURES as CAPABILITY_MEASURES
from rebar_depth_bench.extended.inspection.measures import MISS_MM
from rebar_depth_bench.extended.inspection.tolerances import PROFILES
from rebar_depth_bench.extended.measures import Measure, Statistic
from rebar_depth_bench.extended.result import (
    Estimate,
    ExtendedResult,
    ExtendedView,
    tabulate_extended,
    view_numbers,
)
from rebar_depth_bench.reporting.html.extended import FIRST, estimate_cell, extended_section, meanings
from rebar_depth_bench.reporting.html.page import render_report
from rebar_depth_bench.scoring.result import Result
from tests.bench.reporting.pages import Page
from tests.bench.reporting.results import HOSTILE, result, scored
from tests.bench.reporting.test_report import panels

VIEWS = 6
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
    **{
        f"cloud_{kind}_{t}mm": 0.1 + t / 40
        for kind in ("accuracy", "completeness", "f")
        for t in (1, 2, 5, 10, 20)
    },
    **{f"abs_rel_at_{name}": level for name, level in (("0.3-0.4m", 0.02), ("0.4-0.5m", 0.04), ("8-12px", 0.03))},
    **{f"scale_at_{name}": level for name, level in (("0.3-0.4m", 0.99), ("0.4-0.5m", 1.01), ("8-12px", 0.98))},
}
"""What each view's samples are about; scaled ones are half of it."""


def view(config: str, index: int, levels: dict[str, float]) -> ExtendedView:
    rng = np.random.default_rng(index)
    samples = {}
    for alignment, measures in measures_by_alignment().items():
        factor = 0.5 if alignment == SCALED else 1.0
        of_view: dict[str, np.ndarray] = {one.sample: np.empty(0) for one in measures}
        for name in of_view.keys() & levels.keys():
            level = levels[name]
            spread = 0.0 if level == MISS_MM else 0.01 * level
            of_view[name] = factor * (level + spread * rng.uniform(-1, 1, 4))
        samples[alignment] = of_view
    return ExtendedView(f"{config}/{index:04d}", samples)


def extended_of(*configs: str, levels: dict[str, float] | None = None, views: int = VIEWS) -> ExtendedResult:
    measures = measures_by_alignment()
    by_config = {
        config: [view(config, index, LEVELS if levels is None else levels) for index in INDICES[:views]]
        for config in configs
    }
    tables = {config: tabulate_extended(found, INDICES[:views], measures) for config, found in by_config.items()}
    return ExtendedResult(
        measures, tables, [view_numbers(one, measures) for found in by_config.values() for one in found]
    )


def scored_with(extended: ExtendedResult | None, *configs: str) -> Result:
    views = [scored(f"{config}/{index:04d}") for config in configs for index in INDICES]
    return dataclasses.replace(result(*views), extended=extended)


@pytest.fixture(scope="module")
def lattice() -> ExtendedResult:
    return extended_of("lattice")


@pytest.fixture(scope="module")
def rendered(lattice: ExtendedResult) -> str:
    return render_report(scored_with(lattice, "lattice"), [])


def section_of(page: str) -> str:
    found = re.search(r'<section aria-labelledby="extended".*?</section>', page, re.DOTALL)
    assert found
    return found[0]


def cells_of(page: str, label: str, name: str) -> list[str]:
    """Return the cells of the row ``name`` of the table ``label``, value and interval joined by a space."""
    table = re.search(rf'<table[^>]* aria-label="{re.escape(label)}">.*?</table>', page, re.DOTALL)
    assert table, label
    rows = [
        [Page(cell).text.strip() for cell in re.findall(r"<t[hd].*?</t[hd]>", row)]
        for row in re.findall(r"<tr>.*?</tr>", table[0], re.DOTALL)
    ]
    return next(cells[1:] for cells in rows if cells[0] == name)


def test_without_extended_measures_there_is_no_section() -> None:
    page = render_report(scored_with(None, "lattice"), [])
    assert 'aria-labelledby="extended"' not in page
    assert "Extended measures" not in page


def unfolded(section: str) -> str:
    inner = re.sub(r'<details class="meanings">.*?</details>', "", section, flags=re.DOTALL)
    return re.sub(r"<details>.*?</details>", "", inner, flags=re.DOTALL)


def test_inspection_stands_open_with_native_beside_scaled(rendered: str, lattice: ExtendedResult) -> None:
    opened, label = unfolded(section_of(rendered)), "lattice: Inspection, bar by bar"
    found = cells_of(opened, label, "bars found %\xa0↑")
    assert [cell[:3] for cell in found] == ["87.", "43.", "24"]
    numbers = lattice.tables["lattice"].numbers
    spacing = cells_of(opened, label, "bar spacing: bias mm")
    for alignment, cell in zip((NATIVE, SCALED), spacing, strict=False):
        one = numbers[alignment]["spacing_bias_mm"]
        assert one.value is not None
        assert one.interval is not None
        value, low, high = (f"{number:.2f}".replace("-", "−") for number in (one.value, *one.interval))
        assert cell == f"{value} {low} to {high}", alignment
    assert set(FIRST) < {measure.name for measure in FAMILIES["inspection"].measures}


def test_what_is_missed_is_said_and_not_shown_as_a_length(rendered: str) -> None:
    layer = cells_of(rendered, "lattice: Inspection, bar by bar", "layer distance: p95 error mm\xa0↓")
    assert layer == ["missed", "50.00 50.00 – 50.00", "24"]
    assert "missed: 100 mm, which stands for what was not found." in Page(rendered).text


def test_tolerances_stand_with_pass_rate_capability_and_source(rendered: str, lattice: ExtendedResult) -> None:
    label = "lattice: tolerances of inspection"
    limit, *passes_and_capabilities = cells_of(rendered, label, "GB 50204 bar spacing")
    assert limit == "10"
    assert [cell[:3] for cell in passes_and_capabilities[:2]] == ["62.", "31."]
    numbers = lattice.tables["lattice"].numbers
    for alignment, cell, expected in zip((NATIVE, SCALED), passes_and_capabilities[2:], (2.5, 5.0), strict=True):
        one = numbers[alignment]["capability_gb50204_spacing"]
        assert one.value == pytest.approx(expected, rel=0.02)
        assert one.interval is not None
        assert cell == f"{one.value:.2f} {one.interval[0]:.2f} – {one.interval[1]:.2f}"
    assert cells_of(rendered, label, "GB 50204 distance of layers")[3:] == ["not told", "0.10 0.10 – 0.10"]
    text = Page(rendered).text
    assert "not told: 5 % or more were not found" in text
    assert all(profile.source in text for profile in PROFILES)
    assert "ACI" not in section_of(rendered)


def test_every_heading_states_its_alignment(rendered: str) -> None:
    section = section_of(rendered)
    heads = re.findall(r'<th [^>]*class="alignment ([a-z]+)[^"]*"[^>]*>(.*?)</th>', section, re.DOTALL)
    asides = {
        "native": "no alignment",
        "scaled": "oracle median scale per view",
        "once": r"own alignment, named in the row|no scale changes it",
    }
    assert {kind for kind, _ in heads} == set(asides)
    for kind, content in heads:
        assert re.search(f'{kind}<span class="unit">({asides[kind]})</span>', content), content


def test_families_are_folded_and_every_number_can_be_looked_up(rendered: str) -> None:
    section = section_of(rendered)
    assert "<details open" not in section
    for key in ("full_mask", "boundary", "layers", "clouds", "alignment"):
        assert f"<summary>{FAMILIES[key].title} <" in section
    page = Page(rendered)
    for measure in (*FAMILIES["layers"].measures, *FAMILIES["alignment"].measures):
        assert re.sub(r"\s+", " ", measure.definition) in page.text, measure.name
    assert "title=" not in section, "reached by touch and keyboard, not by hovering"


def test_clouds_are_a_grid_of_tolerances(rendered: str) -> None:
    for tolerance_mm in (1, 2, 5, 10, 20):
        shown = cells_of(rendered, "lattice: Point clouds", str(tolerance_mm))
        native = 100 * (0.1 + tolerance_mm / 40)
        values = [float(cell.split()[0]) for cell in shown]
        assert values == pytest.approx([native] * 3 + [native / 2] * 3, abs=1.0)
    assert rendered.count('aria-label="lattice: Point clouds"') == 2
    assert re.search(r'<table class="sortable" aria-label="lattice: Point clouds"', rendered)


def test_charts_show_the_bins_that_have_values(rendered: str) -> None:
    section = section_of(rendered)
    charts = re.findall(r"<svg.*?</svg>", section, re.DOTALL)
    assert len(charts) == 2
    assert "0.3 to 0.4 m: AbsRel native 0.02" in charts[0]
    assert charts[0].count("<circle") == 2 * 3
    assert charts[1].count("<circle") == 1 * 3
    assert all(f">{edge}</text>" in charts[0] for edge in ("0.3", "0.4", "0.5"))
    assert ">0.2</text>" not in charts[0].replace("0.02", "")


def test_configs_without_anything_to_say_and_with_too_few_views() -> None:
    nothing = render_report(scored_with(extended_of("lattice", levels={}), "lattice"), [])
    assert "No bar of these views is straight, long and wide enough to be judged." in nothing
    assert "<svg" not in section_of(nothing)
    few = extended_of("lattice", views=2)
    section = section_of(render_report(scored_with(few, "lattice"), []))
    assert 'class="interval"' not in section
    assert "slim interval" not in section


def test_the_page_nests_and_names_stay_text() -> None:
    name = HOSTILE.replace("/", "")
    page = Page(render_report(scored_with(extended_of("lattice", name), "lattice", name), [panels()]))
    assert len(page.named("script")) == 1
    assert "\x1b" not in page.text
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(ids) == len(set(ids))


def test_same_input_same_bytes(lattice: ExtendedResult) -> None:
    first, second = (render_report(scored_with(one, "lattice"), []) for one in (lattice, extended_of("lattice")))
    assert first == second


def test_a_section_has_every_config_in_order() -> None:
    section = extended_section(extended_of("pile", "lattice"))
    assert [config.name for config in section.configs] == ["pile", "lattice"]
    assert all(len(config.tolerances) == len(CAPABILITY_MEASURES) for config in section.configs)


def measure(unit: str, statistic: Statistic = "mean") -> Measure:
    return Measure("m", "s", statistic, "M", unit, "", "for this test")


@pytest.mark.parametrize(
    ("estimate", "unit", "text", "interval"),
    [
        (Estimate(0.1234, (0.1, 0.2), 9), "%", "12.3", "10.0 – 20.0"),
        (Estimate(-1.005, (-2.0, 0.5), 9), "mm", "−1.00", "−2.00 to 0.50"),
        (Estimate(1e-9, None, 9), "", "1.0e−09", ""),
        (Estimate(math.inf, (1.0, math.inf), 9), "cm", "–", ""),
        (Estimate(None, None, 0), "mm", "–", ""),
    ],
)
def test_estimates_are_spelled_by_their_unit(estimate: Estimate, unit: str, text: str, interval: str) -> None:
    cell = estimate_cell(estimate, measure(unit))
    assert (cell.text, cell.interval) == (text, interval)


def test_capabilities_are_spelled_as_ratios() -> None:
    spelled = [
        estimate_cell(one, CAPABILITY_MEASURES[0]).text
        for one in (
            Estimate(2.5, None, 9),
            Estimate(math.inf, None, 9),
            Estimate(None, None, 9),
            Estimate(None, None, 0),
        )
    ]
    assert spelled == ["2.50", "∞", "not told", "–"]


def test_definitions_that_differ_by_a_step_are_given_once() -> None:
    found = {one.name: one.definition for one in meanings(FAMILIES["clouds"].measures)}
    assert list(found) == ["Cloud accuracy, N mm", "Cloud completeness, N mm", "Cloud F-score, N mm"]
    assert found["Cloud accuracy, N mm"].endswith("; N: 1, 2, 5, 10, 20")
    boundary = {one.name: one.definition for one in meanings(FAMILIES["boundary"].measures)}
    assert "at t = N % (" in boundary["Boundary F1, steps over N %"]
    assert "max/min > 1 + t" in boundary["Boundary F1, steps over N %"], "what is no step stays"
    assert "t = 1, 2, 5, 10, 20 %" in boundary["Boundary F1"]
    alike = [
        dataclasses.replace(measure("%"), title=f"In {t} mm", definition=f"{t} mm, 24 px off") for t in (3, 5)
    ]
    assert [one.definition for one in meanings(alike)] == ["N mm, 24 px off; N: 3, 5"]
    profile = [one.name for one in meanings(FAMILIES["profile"].measures)]
    assert profile == ["Scale s at N m", "AbsRel at N m", "Scale s on bars of N px", "AbsRel on bars of N px"]
