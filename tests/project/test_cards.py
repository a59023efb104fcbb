"""Dataset and benchmark cards: agreement with the code and the dataset folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

import rebar_depth_bench as rdb
from benchmarks import steel_coverage
from cards.benchmark import benchmark_card
from cards.dataset import column_rows, dataset_card
from cards.steel import steel_by_config
from dataset_builder.cameras.steel_distance import Cylinders
from dataset_builder.cameras.trajectories import view_count
from dataset_builder.catalog.named_configs import CONFIGS, SWEEPS
from dataset_builder.specs.config_specs import DomeSpec
from rebar_depth_bench.data.bars import read_bars
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.schema import CENTRE, NEAREST_STEEL, features
from rebar_depth_bench.methods import own_methods


def test_benchmark_card_in_repository_is_up_to_date() -> None:
    assert Path("cards/BENCHMARK.md").read_text() == benchmark_card(), "run `make cards`"


def test_benchmark_card_names_every_method_and_rule() -> None:
    card = benchmark_card()
    assert all(f"| `{name}`" in card for name in own_methods())
    assert "max(p/z, z/p) < 1.25" in card
    assert "t = 3, 5, 10, 20 mm" in card
    assert "at least 0.95" in card


def test_names_of_bins_stand_for_their_numbers_only() -> None:
    row = next(line for line in benchmark_card().splitlines() if line.startswith("| `single_bar_within_Nmm`"))
    assert "3 x 3 neighbourhood belongs to one bar with |p - z| <= N mm" in row.replace("\\|", "|")


def test_every_column_is_described_once() -> None:
    rows = column_rows()
    described = [name.strip("`") for row in rows for name in row["names"].split(", ")]
    assert sorted(described) == sorted(features())
    assert {row["type"] for row in rows if "K`" in row["names"]} == {"float64 x 3 x 3"}


def test_dataset_card_yaml_matches_folder(tiny_root: Path) -> None:
    text = (tiny_root / "README.md").read_text()
    metadata = yaml.safe_load(text.split("---")[1])
    assert [config["config_name"] for config in metadata["configs"]] == ["lattice", "lattice-orbit"]
    for config in metadata["configs"]:
        pattern = config["data_files"][0]["path"]
        assert sorted(tiny_root.glob(pattern)) == sorted(tiny_root.glob(f"{config['config_name']}/*.parquet"))
    counts = {info["config_name"]: info["splits"][0]["num_examples"] for info in metadata["dataset_info"]}
    assert counts == {"lattice": 9, "lattice-orbit": 2}


def test_dataset_card_steel_share_matches_masks(tiny_root: Path, tiny_masks: dict[str, np.ndarray]) -> None:
    steel = np.mean([mask.mean() for mask in tiny_masks.values()])
    row = next(line for line in (tiny_root / "README.md").read_text().splitlines() if "`lattice`" in line)
    assert f"| {100 * steel:.1f} % |" in row
    assert len(rdb.load(tiny_root, "lattice")) == int(row.split("|")[3].split()[0])


def test_dataset_card_is_rendered_from_manifest(tiny_root: Path) -> None:
    folder = open_folder(tiny_root)
    card = dataset_card(folder.version, folder.digest, list(folder.config_by_name.values()))
    assert card == (tiny_root / "README.md").read_text()


def test_steel_on_cards_is_of_all_views_of_all_configs() -> None:
    stored = steel_by_config()
    assert set(stored) == {*CONFIGS, *SWEEPS}
    for name, make in {**CONFIGS, **SWEEPS}.items():
        protocol, entry = make().protocol, stored[name]
        assert entry["views"] == view_count(protocol)
        assert (entry["width"], entry["height"]) == (1280, 720)
        assert entry["distance_to"] == (protocol.distance_to if isinstance(protocol, DomeSpec) else CENTRE)


def test_steel_of_a_folder_is_measured(
    tiny_root: Path, tiny_masks: dict[str, np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = open_folder(tiny_root).config("lattice")
    bars = read_bars(tiny_root / "bars.parquet")["lattice"]
    views = steel_coverage.measure_views(config, Cylinders.from_bars(bars))
    entry = steel_coverage.summary(config, views)
    shares = [mask.mean() for mask in tiny_masks.values()]
    assert entry["coverage"] == pytest.approx(
        {"mean": np.mean(shares), "least": min(shares), "most": max(shares)}, rel=1e-5
    )
    assert entry["interior"] == pytest.approx(
        np.mean([view.scored_px / (view.steel_px or np.nan) for view in config.views]), rel=1e-5
    )
    assert entry["scored_views"] == len(config.views)
    assert entry["reference"] == config.references["test"].model_dump()
    nearest_m, near_m, far_m = views[:, :3].T
    assert (nearest_m > 0.1).all()
    assert (near_m > 0.75 * nearest_m).all()
    assert entry["depth_m"] == pytest.approx([near_m.min(), far_m.max()], rel=1e-5)
    steel_coverage.main(str(tiny_root), str(tmp_path / "steel.json"))
    assert "| lattice | all | 9 | 9 |" in capsys.readouterr().out
    assert '"configs": {}' in (tmp_path / "steel.json").read_text(), "the folder has 9 of 504 views"


def test_card_states_what_distances_are_to(tiny_root: Path) -> None:
    folder = open_folder(tiny_root)
    lattice = folder.config("lattice")
    assert lattice.scene.protocol is not None
    protocol = lattice.scene.protocol.model_copy(update={"distance_to": NEAREST_STEEL})
    scene = lattice.scene.model_copy(update={"protocol": protocol})
    pier = lattice.model_copy(update={"name": "pier", "scenes": (scene,)})
    older = lattice.model_copy(update={"name": "pier"})
    rows = {
        kind: next(
            line for line in dataset_card("1.0.0", "d", [config]).splitlines() if line.startswith("| `pier`")
        )
        for kind, config in (("pier", pier), ("older", older))
    }
    assert "| 0.22-0.43 m, nearest steel | 7.4-26.3 m |" in rows["pier"]
    assert "| 0.22-0.43 m | – |" in rows["older"]
