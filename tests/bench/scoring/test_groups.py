"""Tables of groups of views: independent formulas, groups scored alone, and what configs of one scene keep."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import rebar_depth_bench as rdb
from rebar_depth_bench.base.errors import DatasetError
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.data.bars import BARS_FILE, read_bars, write_bars
from rebar_depth_bench.data.files import file_sha256
from rebar_depth_bench.scoring.bootstrap import Blocks, end_percents, resample_scenes
from rebar_depth_bench.scoring.comparison import compare
from rebar_depth_bench.scoring.groups import (
    DISTANCE_EDGES_M,
    GROUPINGS,
    WIDTH_EDGES_PX,
    ViewTraits,
    bar_width_px,
    positions_by_group,
)
from rebar_depth_bench.scoring.reading import read_result, read_table
from rebar_depth_bench.scoring.result import Result
from tests.bench.reporting.pages import Page
from tests.damage import change_manifest
from tests.ground_truth import truth_of
from tests.synthetic_dataset import HEIGHT, write_archive, write_dataset, write_split_dataset

# The depth of a bar is 0.3 m + 0.01 m times ten times the number of its scene, and more downwards.
_NUMBERS_OF_FAMILY = {"a": (1, 5, 10, 25, 3, 5, 1, 26), "b": (2, 9, 18, 38)}
NUMBERS = {
    f"{key}{n}": number for key, numbers in _NUMBERS_OF_FAMILY.items() for n, number in enumerate(numbers, 1)
}
FAMILIES = {name: {"a": "wall", "b": "beam"}[name[0]] for name in NUMBERS}
DIAMETERS_M = {name: 0.006 * number for number, name in enumerate(NUMBERS, start=1)}
SCENES = dict.fromkeys(NUMBERS, "test")
VIEWS = 2
FOCAL_PX = 100.0


def write_cages(root: Path, names: list[str]) -> Path:
    chosen = {name: split for name, split in SCENES.items() if name in names}
    write_split_dataset(root, chosen, VIEWS, families=FAMILIES, numbers=NUMBERS, diameters_m=DIAMETERS_M)
    return root


def write_noisy(root: Path, archive: Path, method: str = "noisy", factor: float = 1.0) -> Path:
    """Write predictions that depend on the id of the view alone; a quarter of the pixels have none."""
    with rdb.SubmissionWriter(archive, method, inputs="rgb", uses_ground_truth=False) as writer:
        for row in rdb.load(root, "cages", columns=["view_id", "left_depth"], streaming=True):
            rng = np.random.default_rng(list(row["view_id"].encode()))
            noise = factor * (1.02 + 0.05 * rng.standard_normal(row["left_depth"].shape))
            noise[rng.random(noise.shape) < 0.25] = np.nan
            writer.add(row["view_id"], (row["left_depth"] * noise).astype(np.float32))
    return archive


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_cages(tmp_path_factory.mktemp("groups") / "dataset", list(SCENES))


@pytest.fixture(scope="module")
def archive(root: Path) -> Path:
    return write_noisy(root, root.parent / "noisy.zip")


@pytest.fixture(scope="module")
def scored(root: Path, archive: Path) -> Result:
    return rdb.score(archive, root)


@pytest.mark.slow
def test_views_are_grouped_by_family_distance_and_width(scored: Result) -> None:
    """Depth grows by 1 mm from row to row, from the first to the last of the 88 scored rows."""
    groups = scored.tables["cages"].groups
    assert list(groups) == ["family", "distance", "bar_width"]
    distances_m = {
        name: [0.3 + 0.01 * (10 * number + n) + 0.001 * (HEIGHT - 1) / 2 for n in range(VIEWS)]
        for name, number in NUMBERS.items()
    }
    widths_px = [FOCAL_PX * DIAMETERS_M[name] / z for name, of_scene in distances_m.items() for z in of_scene]
    expected = {
        "family": {"beam": 4 * VIEWS, "wall": 8 * VIEWS},
        "distance": counts_of_bins(
            [z for of_scene in distances_m.values() for z in of_scene], (0, 0.5, 1, 2, 4), "m"
        ),
        "bar_width": counts_of_bins(widths_px, (0, 2, 4, 8, 16), "px"),
    }
    found = {key: {group: table.views for group, table in tables.items()} for key, tables in groups.items()}
    assert found == expected
    assert [list(tables) for tables in found.values()] == [list(tables) for tables in expected.values()]
    assert {table.split for tables in groups.values() for table in tables.values()} == {"test"}


def counts_of_bins(values: list[float], edges: tuple[float, ...], unit: str) -> dict[str, int]:
    """Return how many values are in each bin that has some, by the name of the bin, in ascending order."""
    names = [*(f"{low:g}-{high:g} {unit}" for low, high in pairwise(edges)), f"{edges[-1]:g}+ {unit}"]
    counts, _ = np.histogram(values, [*edges, math.inf])
    return {name: int(count) for name, count in zip(names, counts, strict=True) if count}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("key", "group"), [("family", "wall"), ("family", "beam"), ("distance", "0.5-1 m"), ("distance", "4+ m")]
)
def test_table_of_a_group_is_that_of_its_views_scored_alone(
    scored: Result, tmp_path: Path, key: str, group: str
) -> None:
    """Score the same predictions on a dataset that has the scenes of the group alone."""
    names = {
        "wall": [name for name in SCENES if name[0] == "a"],
        "beam": [name for name in SCENES if name[0] == "b"],
        "0.5-1 m": ["b1", "a2", "a5", "a6"],
        "4+ m": ["b4"],
    }[group]
    alone_root = write_cages(tmp_path / "alone", names)
    alone = rdb.score(write_noisy(alone_root, tmp_path / "alone.zip"), alone_root).to_dict()["tables"]["cages"]
    del alone["groups"]
    of_group = scored.to_dict()["tables"]["cages"]["groups"][key][group]
    assert of_group == alone
    has_interval = len(names) >= 8
    assert (of_group["ci95"]["rank_error"] is not None) == has_interval


def test_result_with_groups_is_read_unchanged(scored: Result) -> None:
    assert read_result(scored.to_json(), "x").to_json() == scored.to_json()
    table = scored.to_dict()["tables"]["cages"]
    assert read_table(table).groups == {}


def test_frame_of_groups_has_the_numbers_of_the_json(scored: Result) -> None:
    frame = scored.to_pandas("groups").set_index(["config", "split", "grouping", "group"])
    groups = scored.to_dict()["tables"]["cages"]["groups"]
    assert list(frame.index) == [("cages", "test", key, group) for key in groups for group in groups[key]]
    for key, tables in groups.items():
        for group, table in tables.items():
            row = frame.loc[("cages", "test", key, group)]
            assert row["scaled_rmse_cm"] == table["scaled"]["rmse_cm"]
            assert row["one_pixel_abs_rel"] == table["reference"]["one_pixel"]["abs_rel"]
    wall = frame.loc[("cages", "test", "family", "wall")]
    assert [wall["rank_error_low"], wall["rank_error_high"]] == groups["family"]["wall"]["ci95"]["rank_error"]


def test_configs_of_one_scene_have_no_groups_and_need_no_bars(tmp_path: Path) -> None:
    write_dataset(tmp_path / "one", ["lattice"], 6)
    assert not (tmp_path / "one" / BARS_FILE).exists()
    write_archive(tmp_path / "a.zip", ["lattice"], 6, "noisy", 0)
    result = rdb.score(tmp_path / "a.zip", tmp_path / "one")
    assert result.tables["lattice"].groups == {}
    assert b"groups" not in result.to_json()
    frame = result.to_pandas("groups")
    assert frame.empty
    assert {"grouping", "group", "rank_error", "rank_error_low"} <= set(frame.columns)


@pytest.mark.parametrize("damage", ["removed", "changed"])
def test_split_without_sound_bars_is_refused(tmp_path: Path, damage: str) -> None:
    copy = write_cages(tmp_path / "copy", ["a1", "b1"])
    archive = write_noisy(copy, tmp_path / "a.zip")
    bars = copy / BARS_FILE
    if damage == "removed":
        bars.unlink()
    else:
        bars.write_bytes(bars.read_bytes() + b"x")
    with pytest.raises(DatasetError, match=r"bars\.parquet"):
        rdb.score(archive, copy)


def test_cached_widths_follow_the_bars(tmp_path: Path) -> None:
    """Another table of bars of the same views gives other widths, although their ground truth is in the cache."""
    copy = write_cages(tmp_path / "copy", ["a1", "b1"])
    before = truth_of(copy, "cages", "test").traits
    scenes = read_bars(copy / BARS_FILE)
    doubled = {
        name: tuple(replace(bar, diameter_m=2 * bar.diameter_m) for bar in bars) for name, bars in scenes.items()
    }
    write_bars(copy / BARS_FILE, doubled)
    change_manifest(
        copy, lambda manifest, _: manifest["files"].update({BARS_FILE: file_sha256(copy / BARS_FILE)}), "cages"
    )
    after = truth_of(copy, "cages", "test").traits
    assert [view.bar_width_px for view in after] == [2 * (view.bar_width_px or 0) for view in before]


def test_groups_of_predictions_that_are_not_metric(
    root: Path, archive: Path, tmp_path: Path, scored: Result, capsys: pytest.CaptureFixture[str]
) -> None:
    aligned = rdb.score(archive, root, align="affine-depth")
    frame, views = aligned.to_pandas("groups"), aligned.to_pandas("views")
    expected = scored.to_pandas("groups")
    assert list(frame["group"]) == list(expected["group"])
    assert list(frame["views"]) == list(expected["views"])
    families = frame[frame["grouping"] == "family"].set_index("group")["aligned_error"]
    names = {"wall": "/test-a", "beam": "/test-b"}
    for family, part in names.items():
        of_family = views[views["view_id"].str.contains(part)]["aligned_error"]
        assert families[family] == pytest.approx(of_family.mean())
    low, high = aligned.tables["cages"].intervals["aligned.error"] or (math.nan, math.nan)
    assert low < views["aligned_error"].mean() < high, "of scenes"
    read = read_result(aligned.to_json(), "x")
    assert read.to_json() == aligned.to_json()
    page = tmp_path / "report.html"
    options = ["--align", "affine-depth", "--html", str(page), "--groups-csv", str(tmp_path / "groups.csv")]
    assert main(["score", str(archive), "--data", str(root), *options]) == 0
    shown = capsys.readouterr().out
    text = Page(page.read_text()).text
    for error in families:
        assert f"{error:.4f}" in shown
        assert f"{error:.4f}" in text
    assert (tmp_path / "groups.csv").read_text().count("\n") == len(frame) + 1


def test_comparison_resamples_scenes(root: Path, tmp_path: Path, scored: Result) -> None:
    other = rdb.score(write_noisy(root, tmp_path / "b.zip", "other", 1.05), root)
    [row] = [row for row in compare(scored, other).configs["cages"] if row.column.place == "rank_error"]
    change = [b.error - a.error for a, b in zip(scored.views, other.views, strict=True)]
    by_scene = np.reshape(change, (len(SCENES), VIEWS))
    counts = resample_scenes(list(SCENES)).counts
    means = [np.repeat(by_scene, drawn.astype(int), axis=0).mean() for drawn in counts]
    assert row.interval == pytest.approx(np.percentile(means, end_percents(Blocks(len(SCENES)))))


traits = st.builds(
    ViewTraits,
    st.sampled_from([None, "wall", "slab", "column"]),
    st.floats(1e-3, 1e3),
    st.none() | st.floats(1e-3, 1e3),
)


@pytest.mark.slow
@given(st.lists(traits, max_size=30))
def test_groups_are_a_partition_of_the_views_that_have_the_property(views: list[ViewTraits]) -> None:
    values: dict[str, list[object]] = {
        "family": [view.family for view in views],
        "distance": [view.distance_m for view in views],
        "bar_width": [view.bar_width_px for view in views],
    }
    for key, grouping in GROUPINGS.items():
        groups = positions_by_group(grouping, views)
        placed = [position for positions in groups.values() for position in positions]
        assert sorted(placed) == [position for position, value in enumerate(values[key]) if value is not None]
        assert all(positions == sorted(positions) and positions for positions in groups.values())
        known = [group for group in grouping.order if group in groups]
        assert list(groups) == (known or sorted(groups))


@pytest.mark.parametrize(("key", "edges"), [("distance", DISTANCE_EDGES_M), ("bar_width", WIDTH_EDGES_PX)])
def test_bins_include_their_lower_edge(key: str, edges: tuple[float, ...]) -> None:
    grouping = GROUPINGS[key]
    names = grouping.order
    for name, edge in zip(names[1:], edges[1:-1], strict=True):
        below = math.nextafter(edge, 0)
        at, before = (grouping.group_of(ViewTraits("wall", value, value)) for value in (edge, below))
        assert (before, at) == (names[names.index(name) - 1], name)


@given(
    st.lists(st.tuples(st.floats(0.125, 10, width=32), st.integers(0, 5)), min_size=1, max_size=40),
    st.dictionaries(st.integers(1, 5), st.floats(0.004, 0.05)),
)
def test_bar_width_is_the_median_over_pixels_of_known_bars(
    pixels: list[tuple[float, int]], diameter_m: Mapping[int, float]
) -> None:
    depth_m, bar_id = np.array([z for z, _ in pixels], np.float32), np.array([bar for _, bar in pixels], np.uint16)
    widths = [700 * diameter_m[bar] / z for z, bar in pixels if bar in diameter_m]
    found = bar_width_px(depth_m, bar_id, diameter_m, 700.0)
    assert (found is None) == (not widths)
    if found is not None:
        assert found == pytest.approx(np.median(widths), rel=1e-12)
