"""Damaged and hostile dataset folders: each is refused with a DatasetError, in little time and memory."""

from __future__ import annotations

import io
import math
import os
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

import rebar_depth_bench as rdb
from rebar_depth_bench.base.errors import DatasetError
from rebar_depth_bench.base.limits import CELL_BYTES, TABLE_BYTES
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.data.bars import BARS_SCHEMA, Bar, read_bars, with_axis, write_bars
from rebar_depth_bench.data.codecs import encode_depth, encode_png
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.rows import iterate_rows
from rebar_depth_bench.data.schema import COLUMNS
from tests.commands import run_in_process
from tests.damage import change_manifest, change_rows, copy_dataset, first_shard
from tests.ground_truth import truth_of

Rows = list[dict[str, Any]]
CONFIG = "lattice-orbit"
GRID = (90, 160)


@pytest.fixture
def copy(tiny_root: Path, tmp_path: Path) -> Path:
    return copy_dataset(tiny_root, tmp_path / "dataset")


def read_all(root: Path) -> Rows:
    return list(iterate_rows(open_folder(root).config(CONFIG), COLUMNS))


def refusal(root: Path) -> str:
    """Return the message with which a config is refused by the iterator and by both ways to load it."""
    with pytest.raises(DatasetError) as raised:
        read_all(root)
    for streaming in (False, True):
        with pytest.raises(DatasetError):
            list(rdb.load(root, CONFIG, streaming=streaming))
    return str(raised.value)


def image(array: np.ndarray, kind: str = "PNG") -> dict[str, Any]:
    stream = io.BytesIO()
    Image.fromarray(array).save(stream, kind)
    return {"bytes": stream.getvalue(), "path": None}


def depth_in_tiles() -> bytes:
    """Return a TIFF of tiles, which may be larger than the image and are decoded as a whole."""
    tags = {256: 160, 257: 90, 258: 32, 259: 1, 262: 1, 277: 1, 322: 16384, 323: 16384, 324: 8, 325: 4, 339: 3}
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags.items())
    return b"II*\0" + struct.pack("<IIH", 12, 0, len(tags)) + entries + bytes(4)


IDENTITY = np.eye(4).tolist()
TURNED = [[0.0, 2.0, 0.0, 0.0], *IDENTITY[1:]]
MIRRORED = [[-1.0, 0.0, 0.0, 0.0], *IDENTITY[1:]]


@pytest.mark.parametrize(
    ("column", "cell"),
    [
        ("left_depth", b""),
        ("left_depth", None),
        ("left_depth", b"II*\0" + b"\xff" * 100),
        ("left_depth", encode_depth(np.ones((90, 161), np.float32))),
        ("left_depth", image(np.ones(GRID, np.uint8), "TIFF")["bytes"]),
        ("left_depth", image(np.ones(GRID, np.int32), "TIFF")["bytes"]),
        ("left_depth", encode_depth(np.full(GRID, np.inf, np.float32))),
        ("left_depth", encode_depth(np.full(GRID, np.nan, np.float32))),
        ("left_depth", encode_depth(np.full(GRID, -1, np.float32))),
        ("left_depth", depth_in_tiles()),
        ("right_depth", encode_depth(np.ones(GRID, np.float32))[:-20]),
        ("left_mask", {"bytes": encode_png(np.ones((180, 160), bool)), "path": None}),
        ("left_mask", {"bytes": None, "path": "/etc/hostname"}),
        ("left_mask", None),
        ("left_bars", image(np.ones((90, 160, 3), np.uint8))),
        ("left_rgb", {"bytes": b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 160 90\n", "path": None}),
        ("right_rgb", image(np.ones((91, 160, 3), np.uint8))),
        ("left_preview", {"bytes": b"RIFF\x00\x00\x00\x00WEBPVP8X", "path": None}),
        ("left_K", [[np.nan] * 3] * 3),
        ("right_distortion", [0.0, np.inf, 0.0, 0.0, 0.0]),
        ("left_cam_from_world", TURNED),
        ("left_cam_from_world", MIRRORED),
        ("left_cam_from_world", [*IDENTITY[:3], [0.0, 0.0, 1.0, 1.0]]),
        ("baseline_m", np.nan),
        ("baseline_m", None),
    ],
)
def test_damaged_cell_names_view_and_column(copy: Path, column: str, cell: Any) -> None:
    change_rows(first_shard(copy), lambda rows: rows[1].update({column: cell}))
    message = refusal(copy)
    assert f"view {CONFIG}/0075: {column} is damaged" in message
    assert f"rebar-bench verify {copy}" in message


@pytest.mark.usefixtures("empty_cache")
def test_image_of_another_size_is_named_when_scores_read_it(copy: Path) -> None:
    mask = {"bytes": encode_png(np.ones((180, 80), bool)), "path": None}
    for column, cell in (("left_mask", mask), ("left_depth", encode_depth(np.ones((90, 159), np.float32)))):
        change_rows(first_shard(copy), lambda rows, cells={column: cell}: rows[1].update(cells))  # type: ignore[misc]
        with pytest.raises(DatasetError, match=f"view {CONFIG}/0075: {column} is damaged: its size is"):
            truth_of(copy, CONFIG)


def test_cell_above_the_limit_is_refused(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(CELL_BYTES.variable, "10000")
    with pytest.raises(DatasetError, match=CELL_BYTES.variable):
        read_all(copy)


def with_column(table: pa.Table, name: str, column: pa.Array) -> pa.Table:
    return table.set_column(table.schema.get_field_index(name), name, column)


@pytest.mark.parametrize(
    ("change", "options", "said"),
    [
        (lambda table: table.drop_columns(["left_mask"]), {}, "no columns named left_mask"),
        (lambda table: with_column(table, "left_depth", pa.array([1, 2])), {}, "column left_depth is int64"),
        (lambda table: with_column(table, "left_K", pa.array([[1.0], [2.0]])), {}, "ListType can only be casted"),
        (
            lambda table: with_column(table, "left_K", pa.array([[[1.0] * 100_000]] * 2)),
            {},
            "column left_K has 200000 values, expected at most 18",
        ),
        (lambda table: pa.concat_tables([table, table]), {}, "4 rows, expected at most 2"),
        (lambda table: table.slice(0, 1), {}, r"lacks 1 views, among them lattice-orbit/0075"),
        (lambda table: table.take([0, 0]), {}, "view lattice-orbit/0025 occurs twice"),
        # It can expand a thousandfold.
        (lambda table: table, {"compression": "zstd"}, "compressed otherwise than expected: none or snappy"),
    ],
)
def test_shard_of_other_schema_or_rows_or_compression_is_refused(
    copy: Path, change: Callable[[pa.Table], pa.Table], options: Any, said: str
) -> None:
    shard = first_shard(copy)
    pq.write_table(change(pq.read_table(shard)), shard, **options)
    with pytest.raises(DatasetError, match=said):
        read_all(copy)


@pytest.mark.parametrize("is_missing", [False, True])
def test_truncated_or_missing_shard_is_named(copy: Path, is_missing: bool) -> None:
    shard = first_shard(copy)
    if is_missing:
        shard.unlink()
        assert f"has no {CONFIG}/{shard.name}" in refusal(copy)
    else:
        shard.write_bytes(shard.read_bytes()[:-100])
        assert f"dataset: config {CONFIG} cannot be read" in refusal(copy)


@pytest.mark.parametrize(
    ("footer", "said"),
    [
        (b"\x1c" * 200, "the footer is nested too deep"),
        (b"\x1d\0", "the footer has a value of type 13, which no Parquet file has"),
        (b"\x07\x02" + bytes(9), r"the footer is damaged \("),
    ],
)
def test_damaged_footer_of_a_shard_is_refused(copy: Path, footer: bytes, said: str) -> None:
    first_shard(copy).write_bytes(b"PAR1" + footer + len(footer).to_bytes(4, "little") + b"PAR1")
    with pytest.raises(DatasetError, match=said):
        read_all(copy)


READ_HUGE_IMAGES = """
import resource, sys
import rebar_depth_bench as rdb
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.rows import iterate_rows
root, name = sys.argv[1:]
for column in ("left_depth", "left_mask"):
    columns = ["view_id", column]
    loaded = [rdb.load(root, name, streaming=streaming, columns=columns) for streaming in (False, True)]
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for rows in (iterate_rows(open_folder(root).config(name), columns), *loaded):
        try:
            list(rows)
        except rdb.DatasetError as error:
            assert f"{name}/0025: {column} is damaged" in str(error), error
            print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


@pytest.mark.slow
def test_huge_images_are_refused_before_they_are_decoded(copy: Path) -> None:
    """Refuse images of 12,000 x 12,000 in a few kilobytes; decoded, one takes 576 MB as depth."""
    depth = encode_depth(np.zeros((12_000, 12_000), np.float32))
    mask = {"bytes": encode_png(np.zeros((12_000, 12_000), bool)), "path": None}
    change_rows(first_shard(copy), lambda rows: rows[0].update(left_depth=depth, left_mask=mask))
    command = [sys.executable, "-c", READ_HUGE_IMAGES, str(copy), CONFIG]
    finished = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    # Not the status: a thread of torch or pyarrow can abort the process after its work, at its exit.
    kilobytes = [int(line) for line in finished.stdout.split()]
    assert len(kilobytes) == 6, finished.stderr
    assert max(kilobytes) < 100_000


def test_view_ids_of_rows_are_those_of_the_manifest(copy: Path) -> None:
    """Refuse the rows of a renamed config, which would score as an empty table."""

    def rename(manifest: Any, config: Any) -> None:
        manifest["configs"]["other"] = manifest["configs"].pop("lattice-orbit")
        config["name"] = "other"
        for view in config["views"]:
            view["view_id"] = view["view_id"].replace("lattice-orbit", "other")

    change_manifest(copy, rename, CONFIG)
    with pytest.raises(DatasetError, match="view lattice-orbit/0025 is not in the manifest"):
        list(iterate_rows(open_folder(copy).config("other"), ["left_K"]))
    with pytest.raises(DatasetError, match="view_id is damaged: it is not in the manifest"):
        list(rdb.load(copy, "other", columns=["view_id"]))


def test_pipes_in_place_of_files_do_not_hang(copy: Path) -> None:
    shard = first_shard(copy).relative_to(copy).as_posix()
    names = ("README.md", "bars.parquet", "meshes/lattice.ply", "pictures/scenes.webp", shard)
    for name in names:
        replace_with_pipe(copy / name)
    finished = run_in_process(main, "verify", copy)
    assert finished.returncode == 2
    assert all(f"{name}: cannot be read: it is a named pipe" in finished.stderr for name in names)
    assert "named pipe" in refusal(copy)
    with pytest.raises(DatasetError, match="named pipe"):
        read_bars(copy / "bars.parquet")
    replace_with_pipe(copy / "manifest.json")
    with pytest.raises(DatasetError, match="named pipe"):
        open_folder(copy)


def replace_with_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def test_shards_that_are_links_are_read(copy: Path, tmp_path: Path) -> None:
    """Read a snapshot of the Hub, which consists of links."""
    shard = first_shard(copy)
    blob = shard.rename(tmp_path / "blob")
    shard.symlink_to(blob)
    assert len(read_all(copy)) == 2
    assert len(rdb.load(copy, CONFIG)) == 2


ALIAS_BOMB = "---\na0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{level}: &a{level} [{', '.join([f'*a{level - 1}'] * 10)}]\n" for level in range(1, 8)
)
OUTSIDE = "---\nconfigs:\n- config_name: lattice-orbit\n  data_files:\n  - split: test\n    path: /etc/*\n---\n"


@pytest.mark.parametrize("card", [ALIAS_BOMB + "---\n", OUTSIDE, "---\nx: [\n---\n", "---\nconfigs: 7\n---\n"])
def test_load_never_reads_the_card(copy: Path, card: str) -> None:
    (copy / "README.md").write_text(card)
    rdb.load(copy, CONFIG)
    start = time.process_time()
    for streaming in (False, True):
        loaded = rdb.load(copy, CONFIG, streaming=streaming, columns=["view_id"])
        assert [row["view_id"] for row in loaded] == ["lattice-orbit/0025", "lattice-orbit/0075"]
    assert time.process_time() - start < 1


def test_rebuilt_shard_is_noticed_by_the_cache(copy: Path) -> None:
    first = rdb.load(copy, CONFIG)[0]["baseline_m"]
    change_rows(first_shard(copy), lambda rows: [row.update(baseline_m=first + 1) for row in rows])
    assert rdb.load(copy, CONFIG)[0]["baseline_m"] == first + 1
    assert rdb.load(copy, CONFIG).info.config_name == CONFIG


def test_folder_whose_name_is_a_pattern_is_loaded(tiny_root: Path, tmp_path: Path) -> None:
    root = copy_dataset(tiny_root, tmp_path / "[a] *" / ".hidden")
    assert len(rdb.load(root, CONFIG)) == 2


STRAIGHT = Bar(1, "tie", 0.016, ((0.0, 0.0, 0.0), (0.0, 0.0, 1.5)))
BENT = Bar(65535, "hoop", 0.01, ((0.1, 0.0, 0.0), (0.2, 0.0, 0.0), (0.2, 0.3, 0.0)))
WITHOUT_AXIS = Bar.without_axis(7, "imported")
ROW = {"scene": "pier", "axis": STRAIGHT.axis_m, **{k: v for k, v in asdict(STRAIGHT).items() if k != "axis_m"}}


def write_rows(path: Path, *rows: dict[str, Any], **options: Any) -> Path:
    """Write rows of the table of bars; what they lack is that of ``ROW``."""
    table = pa.Table.from_pylist([ROW | row for row in rows], schema=BARS_SCHEMA)
    pq.write_table(table, path, **options)
    return path


def test_read_bars_returns_what_write_bars_wrote(tmp_path: Path) -> None:
    scenes = {"pier": (STRAIGHT, BENT, WITHOUT_AXIS), "pile": (STRAIGHT,)}
    write_bars(tmp_path / "bars.parquet", scenes)
    read = read_bars(tmp_path / "bars.parquet")
    # Texts, because the diameter of a bar without an axis is NaN, which differs from itself.
    assert repr(read) == repr(scenes)
    row = pq.read_table(tmp_path / "bars.parquet").to_pylist()[2]
    assert (row["bar_id"], row["diameter_m"], row["axis"]) == (7, None, None)
    bar = read["pier"][2]
    assert (bar.has_axis, math.isnan(bar.diameter_m), math.isnan(bar.length_m)) == (False, True, True)
    assert with_axis((STRAIGHT, bar, BENT)) == (STRAIGHT, BENT)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"bar_id": 0}, "bar_id is 0, expected 1 or more"),
        ({"diameter_m": 0.0}, "diameter_m is 0.0, expected a positive length"),
        ({"diameter_m": float("nan")}, "diameter_m is nan"),
        ({"axis": [[0.0, 0.0, 0.0]]}, "expected two or more finite points"),
        ({"axis": [[0.0, 0.0, 0.0], [0.0, float("inf"), 0.0]]}, "expected two or more finite points"),
        ({"axis": [[0.0, 0.0, 0.0], [0.0, None, 0.0]]}, "expected two or more finite points"),
        ({"axis": None, "role": None}, "has no role, axis"),
        ({"axis": None}, "has no axis"),
        ({"diameter_m": None}, "has no diameter_m"),
        ({"diameter_m": None, "axis": None, "role": None}, "has no role$"),
    ],
)
def test_invalid_bar_is_named_in_error(tmp_path: Path, change: dict[str, Any], said: str) -> None:
    path = write_rows(tmp_path / "bars.parquet", change)
    with pytest.raises(DatasetError, match=said) as raised:
        read_bars(path)
    assert f"{path}: bar {change.get('bar_id', 1)} of scene 'pier'" in str(raised.value)


def test_duplicate_bar_id_in_scene_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="scene 'pier' has bar 1 twice"):
        read_bars(write_rows(tmp_path / "bars.parquet", {}, {}))
    assert len(read_bars(write_rows(tmp_path / "bars.parquet", {}, {"scene": "pile"}))) == 2


@pytest.mark.parametrize(
    ("rows", "options", "said"),
    [
        ([{"scene": "../x"}], {}, "name of the scene"),
        ([{"scene": "a\x1b[2J"}], {}, "name of the scene"),
        ([{"role": "a\x1b[2J"}], {}, "role is"),
        ([{"axis": [[0.0, 0.0, 0.0]] * 100_000}], {}, "decoded bytes"),
        ([{"bar_id": index} for index in range(1, 20_000)], {}, "rows, expected at most"),
        ([{}], {"compression": "gzip"}, "compressed otherwise"),
    ],
)
def test_bars_are_checked_before_they_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rows: Rows, options: Any, said: str
) -> None:
    monkeypatch.setenv(TABLE_BYTES.variable, "1000000")
    with pytest.raises(DatasetError, match=said):
        read_bars(write_rows(tmp_path / "bars.parquet", *rows, **options))


def test_missing_or_malformed_file_is_named_in_error(tmp_path: Path) -> None:
    garbage, other = tmp_path / "garbage.parquet", tmp_path / "other.parquet"
    garbage.write_bytes(b"PAR1 no more than that")
    pq.write_table(pa.table({"scene": ["pier"], "bar_id": ["one"]}), other)
    for path in (tmp_path / "missing.parquet", garbage, other):
        with pytest.raises(DatasetError, match=str(path)):
            read_bars(path)
