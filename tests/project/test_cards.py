"""Cards of dataset and benchmark, and the stored results that they show, agree with the code and each other."""

from __future__ import annotations

import json
import math
import re
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.ndimage import binary_erosion

import rebar_depth_bench as rdb
from cards.benchmark import PAGES
from cards.dataset import column_rows, dataset_card
from cards.learned import LEARNED, baseline_tables, learned_tables
from cards.reference import CAGES, FULL_SETS, SUBSET, reference_context, results_file
from cards.steel import steel_by_config
from dataset_builder.cameras.trajectories import view_count
from dataset_builder.catalog.named_configs import CONFIGS, SWEEPS
from dataset_builder.specs.config_specs import DomeSpec
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.schema import CENTRE, NEAREST_STEEL, features
from rebar_depth_bench.extended.families import MEASURE_FAMILIES
from rebar_depth_bench.methods import own_methods
from rebar_depth_bench.reporting.published import published_rows
from tests.building import TINY_DATASET
from tests.project.pages import ROOT

PUBLISHED = (SUBSET, *FULL_SETS, CAGES)
STORED: dict[str, dict[str, Any]] = {name: json.loads(results_file(name).read_text()) for name in PUBLISHED}


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_generated_page_in_repository_is_up_to_date(page: Path) -> None:
    assert page.read_text() == PAGES[page](), "run `make cards`"


@pytest.mark.slow
def test_pages_name_every_method_and_measure() -> None:
    _, measures, results, _ = (PAGES[page]() for page in PAGES)
    assert all(f"| `{name}`" in results for name in own_methods())
    shown = set(re.findall(r"`([\w.]+)`", measures))
    names = {measure.name for family in MEASURE_FAMILIES.values() for measure in family.measures}
    assert names <= shown


def test_every_column_is_described_once() -> None:
    rows = column_rows()
    described = [name.strip("`") for row in rows for name in row["names"].split(", ")]
    assert sorted(described) == sorted(features())
    assert {row["type"] for row in rows if "K`" in row["names"]} == {"float64 x 3 x 3"}


def test_dataset_card_steel_share_matches_masks(tiny_root: Path, tiny_masks: dict[str, np.ndarray]) -> None:
    steel = np.mean([mask.mean() for mask in tiny_masks.values()])
    row = next(line for line in (tiny_root / "README.md").read_text().splitlines() if "`lattice`" in line)
    assert f"| {100 * steel:.1f} % |" in row
    assert len(rdb.load(tiny_root, "lattice")) == int(row.split("|")[3].split()[0])


def test_dataset_card_is_rendered_from_manifest(tiny_root: Path) -> None:
    folder = open_folder(tiny_root)
    card = dataset_card(folder.version, folder.digest, list(folder.config_by_name.values()), folder.files)
    assert card == (tiny_root / "README.md").read_text()


@pytest.mark.parametrize("names", [[], ["bars"], ["bars", "crossings"]])
def test_card_names_the_configs_of_its_tables(names: list[str], tiny_root: Path) -> None:
    folder = open_folder(tiny_root)
    configs = list(folder.config_by_name.values())
    card = dataset_card("1.0.0", "d", configs, {f"{name}.parquet": "0" * 64 for name in names})
    header = yaml.safe_load(card.split("---")[1])
    assert [entry["config_name"] for entry in header["configs"]] == [*folder.configs, *names]
    sentence = re.search("`load_dataset` reads the rows of all scenes as (.*), whose", card)
    assert re.findall("`(.*?)`", sentence[1] if sentence else "") == names


def test_steel_on_cards_is_of_all_views_of_all_configs() -> None:
    stored = steel_by_config()
    assert set(stored) == {*CONFIGS, *SWEEPS}
    for name, make in {**CONFIGS, **SWEEPS}.items():
        protocol, entry = make().protocol, stored[name]
        assert entry["views"] == view_count(protocol)
        assert (entry["width"], entry["height"]) == (1280, 720)
        assert entry["distance_to"] == (protocol.distance_to if isinstance(protocol, DomeSpec) else CENTRE)


@pytest.mark.slow
def test_steel_of_a_folder_is_measured(tiny_masks: dict[str, np.ndarray], tmp_path: Path) -> None:
    """The last numbers of a row are the share of steel in its views, and of steel pixels that are scored."""
    out = tmp_path / "steel.json"
    command = [sys.executable, "-m", "benchmarks.steel_coverage", str(TINY_DATASET), str(out)]
    finished = subprocess.run(command, capture_output=True, text=True, check=True)
    [row] = [line for line in finished.stdout.splitlines() if line.startswith("| lattice |")]
    *counts, nearest, depths, steel, interior = [cell.strip() for cell in row.strip("|").split("|")]
    assert counts == ["lattice", "all", "9", "9"]
    percent = 100 * np.array([mask.mean() for mask in tiny_masks.values()])
    assert steel == f"{percent.mean():.1f} ({percent.min():.1f}-{percent.max():.1f})"
    views = open_folder(TINY_DATASET).config("lattice").views
    assert interior == f"{100 * np.mean([view.scored_px / (view.steel_px or np.nan) for view in views]):.1f}"
    nearest_m, depth_m = (np.array(text.split("-"), float) for text in (nearest, depths))
    assert nearest_m[0] > 0.1
    assert (depth_m > 0.75 * nearest_m).all()
    assert '"configs": {}' in out.read_text(), "the folder has 9 of 504 views"


def test_card_states_what_distances_are_to(tiny_root: Path) -> None:
    folder = open_folder(tiny_root)
    lattice = folder.config("lattice")
    assert lattice.scene.trajectory is not None
    protocol = lattice.scene.trajectory.model_copy(update={"distance_to": NEAREST_STEEL})
    scene = lattice.scene.model_copy(update={"trajectory": protocol})
    pier = lattice.model_copy(update={"name": "pier", "scenes": (scene,)})
    older = lattice.model_copy(update={"name": "pier"})
    rows = {
        kind: next(
            line for line in dataset_card("1.0.0", "d", [config], {}).splitlines() if line.startswith("| `pier`")
        )
        for kind, config in (("pier", pier), ("older", older))
    }
    assert "| 0.22-0.43 m, nearest steel | 7.4-26.3 m |" in rows["pier"]
    assert "| 0.22-0.43 m | – |" in rows["older"]


def test_every_cpu_method_has_a_stored_run() -> None:
    untested = {name for name, method in own_methods().items() if method.info.untested_note}
    assert set(own_methods()) - untested - set(STORED[SUBSET]["results"]) == {"lidar-survey"}
    tables = {name: set(result["tables"]) for name, result in STORED[SUBSET]["results"].items()}
    assert all(tables[name] == {"lattice", "pile", "pier"} for name in ("sgbm", "constant", "truth"))
    assert tables["board-plane"] == tables["sweep-aruco"] == {"lattice", "pile"}, "the pier has no board"
    assert tables["lidar-mobile"] == {"pier"}, "the others are too near for a scanner"


@pytest.mark.parametrize("name", PUBLISHED)
def test_stored_set_is_of_one_dataset(name: str) -> None:
    renders, results = STORED[name]["renders"], STORED[name]["results"]
    assert (renders["width"], renders["height"]) == (640, 360)
    assert renders["views"] == (504 if name in FULL_SETS else renders["views"])
    for method, result in results.items():
        assert set(result["tables"]) <= ({"lattice", "pile", "pier"} if name == SUBSET else {name})
        assert result["submission"]["method"] == method
        assert all(table["views"] <= renders["views"] for table in result["tables"].values())
        assert result["dataset"] == results["truth"]["dataset"]


@pytest.mark.parametrize("name", PUBLISHED)
def test_card_rows_match_stored_results(name: str) -> None:
    results = STORED[name]["results"]
    config = next(iter(results["sgbm"]["tables"]))
    rows = {row["method"]: row for row in reference_context(name)["rows"][config]}
    assert set(rows) == {method for method, result in results.items() if config in result["tables"]}
    table = results["sgbm-filled"]["tables"][config]
    row = rows["sgbm-filled"]
    low, high = table["ci95"]["native"]["abs_rel"]
    assert row["abs_rel"] == f"{table['native']['abs_rel']:.4f} ({low:.3f}-{high:.3f})"
    assert row["rmse"] == f"{table['native']['rmse_cm']:.2f}"
    assert row["coverage"] == f"{math.floor(1000 * table['coverage']) / 10:.1f} %", "rounded down"
    assert row["rank_error"] == f"{table['rank_error']:.4f}"
    assert row["within"] == f"{100 * table['within_mm']['5']:.1f} %"


def test_main_table_has_methods_and_networks_by_rank_error() -> None:
    table = baseline_tables(CAGES)["cages"].splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table[2:-2]]
    networks = json.loads(results_file(LEARNED).read_text())["configs"]["cages"]["methods"]
    metric = {name for name, numbers in networks.items() if numbers["rank_error"] is not None}
    assert {row[0].split("`")[1] for row in rows} == {*STORED[CAGES]["results"], *metric}
    for marked in (False, True):
        errors = [float(row[2]) for row in rows if row[0].endswith("‡") == marked]
        assert errors == sorted(errors)
    [sgbm] = [row for row in rows if row[0] == "`sgbm`"]
    assert sgbm[2] == f"{STORED[CAGES]['results']['sgbm']['tables']['cages']['rank_error']:.4f}"


def test_table_of_readme_has_the_published_rows_and_stored_results() -> None:
    text = PAGES[ROOT / "README.md"]()
    table = text[text.index("<!-- methods -->") : text.index("<!-- end of methods -->")]
    rows = {name: cells.split(" | ") for name, cells in re.findall(r"^\| (.+?) \| (.+) \|$", table, re.MULTILINE)}
    for n, scene in enumerate(("lattice", "pile", "pier")):
        for row in published_rows(scene):
            mark = " †" if row.median_anchored else ""
            assert rows[row.method][n] == f"{row.abs_rel}, {row.abs_rel_scaled}{mark}"
        stored = STORED[SUBSET]["results"]["sgbm-filled"]["tables"][scene]
        errors = [f"{stored[key]['abs_rel']:.3f}" for key in ("native", "scaled")]
        assert rows["SGBM of OpenCV, holes filled"][n] == ", ".join(errors)
        assert stored["coverage"] >= 0.987, "the README states it"
        assert rows["a plane at one depth"][n] == f"scaled {stored['reference']['constant']['abs_rel']:.3f}"


def test_reference_results_refuse_a_folder_with_other_views(
    tiny_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    compute = runpy.run_path("benchmarks/reference.py")["main"]
    assert compute(tmp_path, SUBSET, tiny_root) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"{tiny_root}: the views of lattice, pile, pier are not those of --out")
    assert list(tmp_path.iterdir()) == []


def test_numbers_of_learned_networks_are_those_of_a_known_shift(
    tiny_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Disparities are half a pixel too large in the left half of the image, and missing in the right one."""
    limit_px, views = 33.5, list(rdb.load(tiny_root, "lattice"))
    config_numbers = runpy.run_path("benchmarks/learned.py")["config_numbers"]
    monkeypatch.setitem(config_numbers.__globals__, "REACHES_PX", (limit_px,))
    near, far, reached = 0, 0, []
    with rdb.SubmissionWriter(tmp_path / "sgbm-lattice.zip", method="shifted") as writer:
        for row in views:
            is_left = np.indices(row["left_depth"].shape)[1] < row["left_depth"].shape[1] // 2
            with np.errstate(divide="ignore"):
                true_px = row["left_K"][0, 0] * row["baseline_m"] / row["left_depth"].astype(float)
            scored = binary_erosion(row["left_mask"] > 0, np.ones((3, 3))) & (row["left_depth"] > 0)
            depth_m = row["left_depth"] * true_px / (true_px + 0.5)
            writer.add(row["view_id"], np.where(is_left, depth_m, np.nan))
            near, far = near + (true_px[scored] <= limit_px).sum(), far + (true_px[scored] > limit_px).sum()
            if (true_px[scored] <= limit_px).all():
                reached.append(np.where(is_left, 0.5 / (true_px + 0.5), 1)[scored].mean())
    config = config_numbers(open_folder(tiny_root).config("lattice"), tiny_root, tmp_path)
    [(method, numbers)] = config["methods"].items()
    assert method == "sgbm"
    assert numbers["bias_px"] == pytest.approx(0.5, abs=1e-3)
    assert 0 < len(reached) < len(views)
    assert numbers["reached_rank_error"] == pytest.approx(np.mean(reached), rel=1e-6)
    assert config["reach"] == {
        "33.5": {"pixels": pytest.approx(near / (near + far), abs=1e-4), "views": len(reached)}
    }
    assert "| `sgbm` | " in learned_tables({"lattice": config})["lattice"]
