"""Tests of crossings in report and terminal: marks by error, reach, tables and provenance."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

import rebar_depth_bench as rdb
from rebar_depth_bench.data.files import file_sha256
from rebar_depth_bench.extended.registry import MEASURE_FAMILIES, score_extended
from rebar_depth_bench.extended.result import ExtendedResult
from rebar_depth_bench.reporting.extended_tables import print_extended, reach_sentence
from rebar_depth_bench.reporting.html.extended import error_kind
from rebar_depth_bench.reporting.html.page import look_at_views, write_report
from rebar_depth_bench.scoring.evaluation import open_evaluation
from tests.bench.extended.cage_scenes import HEIGHT, WIDTH
from tests.mat_dataset import CONFIG, VIEWS, write_mat_dataset

pytestmark = pytest.mark.slow

Depths = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def mat(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Depths]:
    root = tmp_path_factory.mktemp("mat")
    return root, write_mat_dataset(root)


def archive_of(path: Path, depths: Depths, shift_mm: dict[int, float], config: str = CONFIG) -> Path:
    """Write the depth of a config's test views, shifted by millimetres by the index of the view."""
    with rdb.SubmissionWriter(path, method="shifted") as writer:
        for view_id, depth_m in depths.items():
            if view_id.startswith(config) and "train" not in view_id:
                shift_m = shift_mm.get(int(view_id[-4:]), 0.0) / 1000
                writer.add(view_id, np.where(depth_m > 0, depth_m + np.float32(shift_m), 0.0).astype(np.float32))
    return path


def extended(archive: Path, root: Path) -> ExtendedResult:
    with open_evaluation(archive, root) as evaluation:
        result = score_extended(evaluation).extended
    assert result is not None
    return result


def test_measures_of_a_config_pool_its_views(mat: tuple[Path, Depths], tmp_path: Path) -> None:
    root, depths = mat
    result = extended(archive_of(tmp_path / "a.zip", depths, {0: 3.0, 1: 7.0, 2: 60.0}), root)
    numbers = result.tables[CONFIG].numbers["native"]
    assert numbers["crossings_judged"].value == 1.0
    assert numbers["crossings_located"].value == pytest.approx(5 / VIEWS)  # A bar 60 mm away is none of ours.
    assert [numbers[f"tie_within_{limit}mm"].value for limit in (2, 5, 10)] == pytest.approx([3 / 6, 4 / 6, 5 / 6])
    assert numbers["tie_p95_mm"].value == 100.0
    assert numbers["tie_along_bias_mm"].value == pytest.approx((3 + 7) / 5, abs=0.2)
    assert numbers["tie_within_5mm"].samples == 4 * VIEWS
    content = result.to_dict()
    assert content["crossings"] == {"file": "crossings.parquet", "sha256": file_sha256(root / "crossings.parquet")}
    assert content["tables"][CONFIG]["crossing_reach"]["native"][0]["verdict"] == "none tested"


def test_older_folder_is_stamped_with_its_bars(mat: tuple[Path, Depths], tmp_path: Path) -> None:
    root, depths = mat
    older = tmp_path / "older"
    older.mkdir()
    write_mat_dataset(older, with_crossings=False)
    archive = archive_of(tmp_path / "a.zip", depths, {})
    found, expected = extended(archive, older), extended(archive, root)
    assert found.crossings is not None
    assert (found.crossings.file, found.crossings.sha256) == ("bars.parquet", file_sha256(older / "bars.parquet"))
    assert found.to_dict()["tables"] == expected.to_dict()["tables"]


def test_report_shows_crossings_by_error(mat: tuple[Path, Depths], tmp_path: Path) -> None:
    root, depths = mat
    archive = archive_of(tmp_path / "a.zip", depths, {0: 3.0})
    with open_evaluation(archive, root) as evaluation:
        result = score_extended(evaluation)
        picture = look_at_views(evaluation, {}, crossings=True).pictures[CONFIG]
        write_report(result, evaluation, tmp_path / "report.html")
    assert (picture.view_id, picture.width, picture.height) == (f"{CONFIG}/0000", WIDTH, HEIGHT)
    assert [(kind, count) for kind, _, count in picture.counts] == [("within5", 4)]
    assert all(0 < x < WIDTH and 0 < y < HEIGHT for _, x, y in picture.marks)
    page = (tmp_path / "report.html").read_text()
    section = page[page.index('<h2 id="crossings">') :]
    assert "<b>By distance</b>" in section
    assert len(re.findall(r'<circle class="within5" cx="\d', section)) == 5  # Four crossings and the legend.
    assert "crossings.parquet, SHA-256" in section
    assert "Native: 95 % of the judged crossings within 5 mm: none tested." in section
    assert "Crossings by angle, gap and bar width" in section
    assert "<script" not in section[: section.index("</section>")]


def test_config_of_several_scenes_has_crossings_of_each(mat: tuple[Path, Depths], tmp_path: Path) -> None:
    root, depths = mat
    result = extended(archive_of(tmp_path / "a.zip", depths, {1: 60.0}, "cages"), root)
    numbers = result.tables["cages"].numbers["native"]
    assert numbers["tie_within_5mm"].samples == 16  # Two scenes of two views in the split test.
    assert numbers["crossings_located"].value == 0.5


@pytest.mark.parametrize(
    ("error_mm", "kind"),
    [
        (0.0, "within2"),
        (2.0, "within2"),
        (2.1, "within5"),
        (9.9, "within10"),
        (10.1, "beyond"),
        (np.inf, "beyond"),
    ],
)
def test_marks_have_the_colour_of_their_error(error_mm: float, kind: str) -> None:
    assert error_kind(error_mm) == kind


def test_terminal_states_the_reach(mat: tuple[Path, Depths], tmp_path: Path) -> None:
    root, depths = mat
    console = Console(record=True, width=120)
    result = extended(archive_of(tmp_path / "a.zip", depths, {}), root)
    print_extended(result, console)
    text = console.export_text()
    assert "tie point: median, mm" in text
    assert reach_sentence("scaled", result.tables[CONFIG].reaches["scaled"][1]) in " ".join(text.split())


def test_reaches_without_the_other_measures_are_the_same(mat: tuple[Path, Depths], tmp_path: Path) -> None:
    root, depths = mat
    archive = archive_of(tmp_path / "a.zip", depths, {0: 3.0})
    with open_evaluation(archive, root) as evaluation:
        found = score_extended(evaluation, [MEASURE_FAMILIES["crossings"]]).extended
    assert found is not None
    assert found.tables[CONFIG].reaches == extended(archive, root).tables[CONFIG].reaches
    heads = {measure.name.partition("_")[0] for measure in found.measures["native"]}
    assert heads == {"crossing", "crossings", "tie"}
    content = json.loads(json.dumps(found.to_dict()))
    assert content["crossings"]["file"] == "crossings.parquet"
    reaches = content["tables"][CONFIG]["crossing_reach"]["native"]
    assert [reach["limit_mm"] for reach in reaches] == [5, 2]
    assert sum(one["crossings"] for one in reaches[0]["bins"]) == 4 * VIEWS
