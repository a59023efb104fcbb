"""Finished configs: they grow, keep their views, and are replaced only if they are named; rows are prepared."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import datasets
import pytest
from pyarrow.compute import field
from pyarrow.dataset import dataset as parquet_dataset

import rebar_depth_bench as rdb
from dataset_builder.catalog.cages_config import CagesRequest
from dataset_builder.catalog.named_configs import BuildRequest
from dataset_builder.pipeline.build import BuildSummary, build
from dataset_builder.pipeline.plan import BUILD_FOLDER
from dataset_builder.pipeline.publish import write_folder
from dataset_builder.specs.config_specs import ColourSpec
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.base.limits import JSON_BYTES, TABLE_BYTES
from rebar_depth_bench.base.parallel import silent
from rebar_depth_bench.data.bars import BARS_FILE, Bar
from rebar_depth_bench.data.files import MANIFEST_FILE, file_problems
from rebar_depth_bench.data.manifest import open_folder
from tests.building import contents
from tests.prepared_rows import BARS, PreparedRows, placed

pytestmark = pytest.mark.slow

SIZE: dict[str, Any] = {"width": 32, "height": 18, "colour": None}


def lattice(views: int, **changes: Any) -> BuildRequest:
    return BuildRequest(**{"configs": ("lattice",), "views": views, **SIZE, **changes})


def cages(scenes: int, views: int = 2, split: str = "test", **changes: Any) -> BuildRequest:
    request = {"configs": ("cages",), **SIZE, "cages": CagesRequest(split, scenes, views), **changes}
    return BuildRequest(**request)


@pytest.fixture(autouse=True)
def cameras_without_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give all generated scenes the same cameras, which takes no time."""
    monkeypatch.setattr("dataset_builder.pipeline.build.place_cameras", lambda plans, *_: [*map(placed, plans)])


def built(out: Path, request: BuildRequest) -> tuple[list[str], BuildSummary]:
    """Build with prepared rows; return the ids of the views that were rendered, and the summary."""
    renderer = PreparedRows()
    summary = build(request, out, submit=renderer.submit)
    return renderer.rendered, summary


class Interrupting(PreparedRows):
    """Renderer that is interrupted after some units."""

    def __init__(self, units: int) -> None:
        super().__init__()
        self._units = units

    def submit(self, *arguments: Any) -> Any:
        if self._units == 0:
            raise KeyboardInterrupt
        self._units -= 1
        return super().submit(*arguments)


@pytest.mark.parametrize(
    ("first", "then", "added"),
    [
        (lattice(2), lattice(6), 4),
        (lattice(9), lattice(45), 36),
        (cages(2), cages(3), 2),
        (cages(2), cages(2, views=3), 2),
    ],
)
def test_growing_config_renders_only_new_views(
    tmp_path: Path, first: BuildRequest, then: BuildRequest, added: int
) -> None:
    built(tmp_path / "grown", first)
    rendered, summary = built(tmp_path / "grown", then)
    assert (len(rendered), summary.built) == (added, [*then.configs])
    built(tmp_path / "at-once", then)
    assert contents(tmp_path / "grown") == contents(tmp_path / "at-once")
    assert built(tmp_path / "grown", then)[0] == []
    assert not (tmp_path / "grown" / BUILD_FOLDER).exists()


def test_build_without_colour_keeps_staged_views_that_may_have_colour(tmp_path: Path) -> None:
    built(tmp_path, lattice(2))
    staged = tmp_path / BUILD_FOLDER / "lattice-0123456789abcdef" / "rows"
    staged.mkdir(parents=True)
    assert built(tmp_path, lattice(6))[1].built == ["lattice"]
    assert staged.is_dir()


def test_views_that_are_not_among_more_views_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    built(tmp_path, lattice(2))
    assert capsys.readouterr().err == ""
    rendered, _ = built(tmp_path, lattice(3))
    assert "config lattice: 2 of 2 finished views are not among the 3 requested" in capsys.readouterr().err
    assert len(rendered) == 3


def test_old_config_stays_readable_while_it_grows_and_after_an_interruption(tmp_path: Path) -> None:
    root = tmp_path / "dataset"
    built(root, lattice(9))
    before = contents(root)
    with pytest.raises(KeyboardInterrupt):
        build(lattice(63), root, submit=Interrupting(1).submit)
    assert {name: digest for name, digest in contents(root).items() if BUILD_FOLDER not in name} == before
    assert len(rdb.load(root, "lattice")) == 9
    problems = file_problems(open_folder(root), silent)
    assert [problem for problem in problems if BUILD_FOLDER not in str(problem)] == []
    rendered, _ = built(root, lattice(63))
    assert 0 < len(rendered) < 63 - 9
    built(tmp_path / "at-once", lattice(63))
    assert contents(root) == contents(tmp_path / "at-once")


@pytest.mark.parametrize(
    ("first", "then", "words"),
    [
        (lattice(6), lattice(2), "6 finished views would be lost: it has 6 views, 2 are requested"),
        (lattice(6), lattice(9, width=64), "6 finished views would be lost: rig.width is 32, 64 is requested"),
        (lattice(6), lattice(6, seed=1), "seed is 0, 1 is requested"),
        (cages(2), cages(2, views=1), "4 finished views would be lost: it has 2 views, 1 are requested"),
        (cages(2), cages(1, seed=1), "2 other scenes have another image size, colour, seed or version"),
        (cages(2), cages(1, split="train", width=64), "2 other scenes have another image size"),
    ],
)
def test_finished_config_is_replaced_only_if_it_is_named(
    tmp_path: Path, first: BuildRequest, then: BuildRequest, words: str
) -> None:
    [name] = then.configs
    built(tmp_path, first)
    before = contents(tmp_path)
    with pytest.raises(InputError, match=f"config {name}: .*--overwrite {name}") as caught:
        built(tmp_path, then)
    assert words in str(caught.value)
    assert contents(tmp_path) == before
    overwriting = BuildRequest(**{**vars(then), "overwrite": (name,)})
    rendered, summary = built(tmp_path, overwriting)
    config = open_folder(tmp_path).config(name)
    assert (summary.built, set(rendered) <= set(config.view_ids)) == ([name], True)
    assert config.rig.width == then.width
    assert {f"{name}/{path.name}" for path in (tmp_path / name).iterdir()} == set(config.shards)


def test_fewer_scenes_and_same_views_lose_nothing(tmp_path: Path) -> None:
    built(tmp_path, cages(3))
    before = contents(tmp_path)
    assert built(tmp_path, cages(1))[1].up_to_date == ["cages"]
    assert contents(tmp_path) == before


def test_name_to_overwrite_has_to_be_built(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--overwrite: got 'pile', expected one of the configs .* lattice"):
        built(tmp_path, lattice(1, overwrite=("pile",)))


def test_imported_config_is_not_replaced_by_a_build(tmp_path: Path) -> None:
    built(tmp_path, lattice(2))
    manifest = json.loads((tmp_path / MANIFEST_FILE).read_text())
    entry = manifest["configs"]["lattice"]
    entry["imported"] = {"truth_sigma_m": 0.001}
    entry["scenes"][0] |= {"assembly": None, "protocol": None, "rig": None, "mesh": None}
    (tmp_path / MANIFEST_FILE).write_text(json.dumps(manifest))
    with pytest.raises(InputError, match="2 finished views would be lost: it was imported"):
        built(tmp_path, lattice(6))


def test_finished_config_without_digests_is_rendered_again(tmp_path: Path) -> None:
    built(tmp_path, lattice(2))
    manifest = json.loads((tmp_path / MANIFEST_FILE).read_text())
    manifest["files"] = {BARS_FILE: manifest["files"][BARS_FILE]}
    manifest["configs"]["lattice"]["scenes"][0]["rig"]["\x1b[2J"] = 1
    (tmp_path / MANIFEST_FILE).write_text(json.dumps(manifest))
    with pytest.raises(InputError, match=r"no digest of pictures/lattice\.webp"):
        built(tmp_path, lattice(6))
    assert len(built(tmp_path, lattice(6, overwrite=("lattice",)))[0]) == 6


def flip_a_byte(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def test_views_of_a_damaged_shard_are_rendered_again(tmp_path: Path) -> None:
    built(tmp_path / "dataset", lattice(18))
    before = contents(tmp_path / "dataset")
    flip_a_byte(next((tmp_path / "dataset").glob("lattice/*-00001-of-*")))
    rendered, _ = built(tmp_path / "dataset", lattice(18))
    assert len(rendered) == 8
    assert contents(tmp_path / "dataset") == before


@pytest.mark.parametrize("pattern", ["lattice/*.parquet", "meshes/lattice.ply", "pictures/lattice.webp"])
def test_damage_of_other_configs_gets_no_new_digest(tmp_path: Path, pattern: str) -> None:
    built(tmp_path, lattice(2))
    damaged = next(tmp_path.glob(pattern))
    flip_a_byte(damaged)
    built(tmp_path, cages(1))
    problems = [problem.where for problem in file_problems(open_folder(tmp_path), silent)]
    assert problems == [damaged.relative_to(tmp_path).as_posix()]


def test_damaged_bars_of_other_scenes_are_refused(tmp_path: Path) -> None:
    built(tmp_path, lattice(2))
    (tmp_path / BARS_FILE).unlink()
    renderer = PreparedRows()
    with pytest.raises(InputError, match=r"bars\.parquet does not match the manifest"):
        build(cages(1), tmp_path, submit=renderer.submit)
    assert renderer.rendered == []


def test_publication_that_was_interrupted_after_writing_bars_is_continued(tmp_path: Path) -> None:
    root, whole = tmp_path / "dataset", tmp_path / "whole"
    built(root, lattice(2))
    manifest = (root / MANIFEST_FILE).read_bytes()
    saved = (root / BARS_FILE).read_bytes()
    built(root, cages(1))
    shutil.copytree(root, whole)
    (root / BUILD_FOLDER).mkdir()
    (root / BUILD_FOLDER / BARS_FILE).write_bytes(saved)
    (root / MANIFEST_FILE).write_bytes(manifest)
    built(root, cages(1))
    assert contents(root) == contents(whole)


def loaded_ids(root: Path) -> list[list[str]]:
    """Return the view ids of ``train`` as plain ``datasets`` and ``load`` return them, streaming and not."""
    return [
        [row["view_id"] for row in load(str(root), "cages", split="train", streaming=streaming)]
        for streaming in (False, True)
        for load in (datasets.load_dataset, rdb.load)
    ]


def first_depth(root: Path) -> list[bytes]:
    plain = datasets.load_dataset(str(root), "cages", split="train")[0]["left_depth"]
    return [plain, rdb.load(root, "cages", split="train", columns=["left_depth"])[0]["left_depth"].tobytes()]


def test_added_and_rebuilt_scenes_are_loaded_in_place_of_cached_ones(tmp_path: Path) -> None:
    """Load with the caches of ``datasets``, which know folders by their paths."""
    root = tmp_path / "dataset"

    def expected() -> list[str]:
        return list(open_folder(root).config("cages").of_split("train").view_ids)

    built(root, cages(1, 1, "train"))
    depth = first_depth(root)
    assert loaded_ids(root) == [expected()] * 4
    built(root, cages(2, 1, "train"))
    assert len(expected()) == 2
    assert loaded_ids(root) == [expected()] * 4
    assert first_depth(root) == depth
    shutil.rmtree(root)
    built(root, cages(1, 1, "train", seed=1, width=64, colour=ColourSpec(1, 1)))
    assert loaded_ids(root) == [expected()] * 4
    assert datasets.load_dataset(str(root), "cages", split="train")[0]["left_rgb"].size == (64, 18)
    assert all(new != old for new, old in zip(first_depth(root), depth, strict=True))
    assert 'load_dataset("PATH_OR_HUB_ID", "cages", split="train")' in (root / "README.md").read_text()


def loaded_rows(root: Path, table: str) -> list[dict[str, Any]]:
    return list(datasets.load_dataset(str(root), table, split="train"))


def test_rebuilt_tables_are_loaded_in_place_of_cached_ones(tmp_path: Path) -> None:
    """The names of the tables stay; a table without rows, which ``datasets`` cannot read, is no config."""
    root = tmp_path / "dataset"
    built(root, cages(1))
    assert [row["bar_id"] for row in loaded_rows(root, "bars")] == [bar.bar_id for bar in BARS]
    assert datasets.get_dataset_config_names(str(root)) == ["cages", "bars"]
    folder = open_folder(root)
    [scene] = folder.config("cages").scenes
    for diameter_m in (0.03, 0.02):
        y_m = 0.01 + diameter_m / 2
        crossing = Bar(5, "bar", diameter_m, ((-0.1, y_m, 0.5), (0.5, y_m, 0.5)))
        write_folder(root, folder, folder.config_by_name, {}, {scene.name: (*BARS, crossing)})
        assert loaded_rows(root, "bars")[-1]["diameter_m"] == diameter_m
        assert [row["point_b"][1] for row in loaded_rows(root, "crossings")] == [pytest.approx(y_m)] * len(BARS)
    assert datasets.get_dataset_config_names(str(root)) == ["cages", "bars", "crossings"]
    assert list(datasets.load_dataset(str(root))) == ["test"], "the only config with views is the default"


def test_filters_skip_the_row_groups_of_other_scenes_and_views(tmp_path: Path) -> None:
    built(tmp_path / "dataset", cages(2))
    view = open_folder(tmp_path / "dataset").config("cages").views[1].view_id
    fragments = list(parquet_dataset(tmp_path / "dataset" / "cages").get_fragments())
    scenes = {fragment.head(1)["scene"][0].as_py() for fragment in fragments}
    assert len(scenes) == 2
    for column, value, rows in [("view_id", view, 1), *(("scene", scene, 2) for scene in scenes)]:
        left = [fragment.subset(field(column) == value).row_groups for fragment in fragments]
        assert sum(map(len, left)) == rows, column
        options: dict[str, Any] = {"filters": [(column, "==", value)], "split": "test", "streaming": True}
        assert len(list(datasets.load_dataset(str(tmp_path / "dataset"), "cages", **options))) == rows
    group = fragments[0].metadata.row_group(0)
    columns = [group.column(index) for index in range(group.num_columns)]
    assert [chunk.path_in_schema for chunk in columns if chunk.is_stats_set] == ["view_id", "scene"]


@pytest.mark.parametrize(("limit", "value"), [(JSON_BYTES, 5000), (TABLE_BYTES, 1000)])
def test_folder_that_could_not_be_read_is_refused_before_rendering(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: Any, value: int
) -> None:
    monkeypatch.setenv(limit.variable, f"{value}")
    with pytest.raises(InputError, match=f"could not be read, expected at most {value} bytes; {limit.variable}"):
        built(tmp_path / "dataset", cages(20))
    assert not (tmp_path / "dataset").exists()


@pytest.mark.parametrize("request_", [lattice(9), lattice(504), cages(80, 3)])
def test_size_of_the_manifest_is_estimated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request_: BuildRequest
) -> None:
    built(tmp_path / "dataset", request_)
    size = (tmp_path / "dataset" / MANIFEST_FILE).stat().st_size
    monkeypatch.setenv(JSON_BYTES.variable, f"{size}")
    with pytest.raises(InputError, match="the manifest of the folder would have about") as caught:
        built(tmp_path / "again", request_)
    estimate = int(str(caught.value).partition("about ")[2].partition(" ")[0])
    assert size <= estimate < 1.5 * size
