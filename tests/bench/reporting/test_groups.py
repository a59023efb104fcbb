"""Tables of groups of views in the terminal, in CSV and in the report."""

from __future__ import annotations

import csv
import io
from dataclasses import replace

import pytest
from rich.console import Console

from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.reporting.html.page import render_report
from rebar_depth_bench.reporting.latex import latex_table
from rebar_depth_bench.reporting.tables import print_table
from rebar_depth_bench.scoring.frames import frame_csv
from rebar_depth_bench.scoring.reference import Errors, Reference
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.scoring.score import tabulate
from tests.bench.reporting.pages import Page
from tests.bench.reporting.results import HOSTILE, REFERENCE, result, scored_view, unpredicted_view

SCENES = 8
NEAR = Reference(Errors(0.2222, 7.89), Errors(0.0333, 4.56))


def split_result(group: str = "wall", grouping: str = "family", scenes: int = SCENES) -> Result:
    """Return a result of the split ``test`` of ``cages``; its last scene is in the other group."""
    views = [scored_view(f"cages/test-s{scene}-0000", 0.1 + 0.01 * scene) for scene in range(scenes)]
    last = unpredicted_view(f"cages/test-s{scenes}-0000")
    table = tabulate([*views, last], reference=REFERENCE, split="test")
    groups = {
        grouping: {
            group: tabulate(views, reference=NEAR, split="test"),
            "slab": tabulate([last], reference=REFERENCE, split="test"),
        },
        "distance": {"0.5-1 m": tabulate([*views, last], reference=REFERENCE, split="test")},
    }
    return replace(result(), tables={"cages": replace(table, groups=groups)}, views=[*views, last])


def printed(shown: Result, width: int) -> list[str]:
    console = Console(width=width, record=True, file=io.StringIO())
    print_table(shown, console)
    return console.export_text().splitlines()


@pytest.mark.parametrize("width", [80, 120])
def test_terminal_has_a_row_for_each_group_with_its_reference_errors(width: int) -> None:
    lines = printed(split_result(), width)
    assert max(map(len, lines)) <= width
    rows = [line.split() for line in lines if line.strip().startswith("wall")]
    assert len(rows) == (1 if width == 120 else 2), "in one table if it fits, else in two"
    cells = [cell for row in rows for cell in row[1:]]
    assert cells[0] == f"{SCENES}/{SCENES}"
    assert {"0.1350", "0.0333", "4.56", "0.0571", "2.21"} <= set(cells)
    text = "\n".join(lines)
    assert text.index("cage family") < text.index("wall") < text.index("slab") < text.index("distance")
    assert formatting.GROUP_NOTE.split(".")[0] in text.replace("\n", " ")


def test_terminal_without_groups_does_not_mention_them() -> None:
    text = " ".join(printed(result(scored_view("lattice/0000")), 120))
    assert "group" not in text


def test_report_has_a_table_for_each_grouping() -> None:
    page = render_report(split_result(), [])
    labels = [attributes.get("aria-label") for attributes in Page(page).attributes_of("table")]
    assert labels.count("cages (test): by cage family") == labels.count("cages (test): by distance") == 1
    row = page[page.index('data-value="1">wall</th>') :].partition("</tr>")[0]
    for text in ("8/8", "0.1350", "0.0333", "4.56", "0.0571", "2.21"):
        assert f">{text}" in row
    assert 'class="interval"' in row
    other = page[page.index('data-value="2">slab</th>') :].partition("</tr>")[0]
    assert 'class="interval"' not in other
    assert "–" in other
    assert "Groups of views" not in render_report(result(scored_view("lattice/0000")), [])


def test_names_of_groups_are_escaped() -> None:
    shown = split_result(HOSTILE, "<b>\x1b[31m")
    page = Page(render_report(shown, []))
    assert page.count("script") == 1, "the report's own"
    assert "\x1b" not in page.text
    assert "\x1b[31m" not in "\n".join(printed(shown, 120))
    [line] = [line for line in frame_csv(shown.to_pandas("groups")).splitlines() if "evil.example" in line]
    assert "'=" in line


def test_csv_has_one_row_for_each_group() -> None:
    shown = split_result()
    rows = list(csv.DictReader(io.StringIO(frame_csv(shown.to_pandas("groups")))))
    assert [(row["config"], row["split"], row["grouping"], row["group"]) for row in rows] == [
        ("cages", "test", "family", "wall"),
        ("cages", "test", "family", "slab"),
        ("cages", "test", "distance", "0.5-1 m"),
    ]
    group = shown.to_dict()["tables"]["cages"]["groups"]["family"]["wall"]
    assert float(rows[0]["rank_error"]) == group["rank_error"]
    assert float(rows[0]["constant_abs_rel"]) == group["reference"]["constant"]["abs_rel"]
    assert float(rows[0]["scaled_constant_abs_rel"]) == group["reference"]["scaled_constant"]["abs_rel"] == 0.0571
    assert rows[1]["native_abs_rel"] == ""
    [header] = frame_csv(result(scored_view("lattice/0000")).to_pandas("groups")).splitlines()
    assert header.split(",")[:8] == list(rows[0])[:8]


def test_notes_state_what_is_resampled() -> None:
    one_scene = result(*(scored_view(f"lattice/{12 * index:04d}") for index in range(8)))
    split = split_result()
    both = replace(split, tables={**split.tables, **one_scene.tables}, views=[*split.views, *one_scene.views])
    assert formatting.interval_note(one_scene.tables.values()) == formatting.INTERVAL_NOTE
    assert "views" not in formatting.interval_note(split.tables.values())
    assert formatting.interval_note(both.tables.values()).startswith(formatting.INTERVAL_NOTE)
    for shown in (one_scene, split, both):
        assert formatting.interval_note(shown.tables.values()) in render_report(shown, [])
    latex = [latex_table([shown], published=False, intervals=True) for shown in (one_scene, split, both)]
    phrases = ("block bootstrap over views", "bootstrap over scenes", "over views, with splits over scenes")
    assert all(phrase in " ".join(text.split()) for phrase, text in zip(phrases, latex, strict=True))
