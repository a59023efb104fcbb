"""Table II on captures and on a rendered dataset, and the depth maps of folders and archives that it reads."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pseudo_reference
import rebar_depth_bench as rdb
from depth_maps import masked, open_maps
from pseudo_reference import agreement
from rebar_depth_bench.base.errors import InputError
from tests.bench.captures.example_capture import (
    HEIGHT,
    VIEWS,
    WIDTH,
    Depth,
    exact_depth,
    write_capture,
    write_depths,
)
from tests.bench.submission.zips import exr, npz, png
from tests.examples.scripts import refusal, repeated_files, result_of, written_files
from tests.synthetic_dataset import write_split_dataset

NOISE = 0.1
STEREO_FACTOR, COLMAP_FACTOR, MONO_FACTOR, OTHER_FACTOR = 1.02, 0.9, 1.6, 0.55


def left_half(depth_m: Depth) -> Depth:
    half_m = depth_m.copy()
    half_m[:, WIDTH // 2 :] = np.nan
    return half_m


def noisy(depth_m: Depth, seed: int) -> Depth:
    noise: Depth = np.exp(NOISE * np.random.default_rng(1000 + seed).standard_normal(depth_m.shape))
    return depth_m * noise


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a capture, two references (full frame, left half) and methods of known errors; return the folder."""
    folder = tmp_path_factory.mktemp("lab")
    write_capture(folder / "zed")
    z_m = {view: exact_depth(view) for view in range(VIEWS)}
    write_depths(folder / "stereo", {view: STEREO_FACTOR * depth_m for view, depth_m in z_m.items()}, "stereo")
    write_depths(
        folder / "colmap", {view: COLMAP_FACTOR * left_half(depth_m) for view, depth_m in z_m.items()}, "colmap"
    )
    write_depths(folder / "mono", {view: MONO_FACTOR * noisy(depth_m, view) for view, depth_m in z_m.items()})
    write_depths(folder / "other", {view: OTHER_FACTOR * depth_m + 0.2 for view, depth_m in z_m.items()})
    return folder


def run_lab(lab: Path, out: Path, *methods: str | Path, options: tuple[str, ...] = ()) -> dict[str, Any]:
    paths = [lab / method for method in methods]
    references = ("--reference", lab / "stereo", lab / "colmap", "--data", lab / "zed")
    return result_of(pseudo_reference, out, *paths, *references, *options)


def row_of(result: dict[str, Any], method: str, reference: str) -> dict[str, Any]:
    return next(row for row in result["rows"] if (row["method"], row["reference"]) == (method, reference))


def test_known_scale_and_noise_are_found(lab: Path, tmp_path: Path) -> None:
    result = run_lab(lab, tmp_path, "mono")
    samples = np.random.default_rng(0).standard_normal(1_000_000)
    for reference, factor, share in (("stereo", STEREO_FACTOR, 1.0), ("colmap", COLMAP_FACTOR, 0.5)):
        row = row_of(result, "mono", reference)
        expected = {
            "scale_median": factor / MONO_FACTOR,
            "native.abs_rel": np.abs(MONO_FACTOR / factor * np.exp(NOISE * samples) - 1).mean(),
            "scaled.abs_rel": np.abs(np.exp(NOISE * samples) - 1).mean(),
        }
        found = {"scale_median": row["scale_median"]}
        found |= {f"{key}.abs_rel": row[key]["abs_rel"] for key in ("native", "scaled")}
        assert found == pytest.approx(expected, rel=0.02)
        assert set(row["ci95"].values()) == {None}, "24 consecutive views are two blocks"
        assert (row["frame_share"], row["coverage"], row["ranked"]) == (share, 1.0, True)
    assert [entry["frame_share"] for entry in result["references"]] == [1.0, 0.5]
    forward, backward = result["agreement"]
    assert (forward["reference"], forward["against"], forward["views"]) == ("stereo", "colmap", VIEWS)
    assert forward["median_ratio"] == pytest.approx(STEREO_FACTOR / COLMAP_FACTOR)
    assert forward["abs_rel"] == pytest.approx(STEREO_FACTOR / COLMAP_FACTOR - 1)
    assert backward["abs_rel"] == pytest.approx(1 - COLMAP_FACTOR / STEREO_FACTOR)
    assert backward["common_share"] == 0.5


def test_score_of_shifted_method_matches_plain_numpy(lab: Path, tmp_path: Path) -> None:
    row = row_of(run_lab(lab, tmp_path, "other"), "other", "colmap")
    views = []
    for view in range(VIEWS):
        z_m = (COLMAP_FACTOR * exact_depth(view)).astype(np.float32).astype(np.float64)[:, : WIDTH // 2].ravel()
        p_m = (
            (OTHER_FACTOR * exact_depth(view) + 0.2).astype(np.float32).astype(np.float64)[:, : WIDTH // 2].ravel()
        )
        s = np.median(z_m) / np.median(p_m)
        rmse_cm = 100 * np.sqrt(np.mean((p_m - z_m) ** 2))
        views.append((np.mean(np.abs(p_m - z_m) / z_m), rmse_cm, np.mean(np.abs(s * p_m - z_m) / z_m), s))
    scored = (row["native"]["abs_rel"], row["native"]["rmse_cm"], row["scaled"]["abs_rel"])
    assert scored == pytest.approx(tuple(np.mean(views, axis=0)[:3]), rel=1e-6)
    assert row["scale_median"] == pytest.approx(np.median([values[3] for values in views]), rel=1e-6)


def test_ratios_and_rankings_are_relative_to_the_first_reference(lab: Path, tmp_path: Path) -> None:
    for name, factor in (("near", 0.93), ("far", 1.05)):
        write_depths(tmp_path / name, {view: factor * exact_depth(view) for view in range(VIEWS)})
    result = run_lab(lab, tmp_path, tmp_path / "near", tmp_path / "far", "mono")
    for method in ("near", "far", "mono"):
        errors = [row_of(result, method, name)["native"]["abs_rel"] for name in ("stereo", "colmap")]
        assert row_of(result, method, "colmap")["ratio"]["native"] == pytest.approx(
            errors[1] / errors[0], rel=1e-11
        )
        assert row_of(result, method, "stereo")["ratio"]["native"] == 1
    rankings = {name: ranking["native"] for name, ranking in result["rankings"].items()}
    assert rankings["stereo"] == {"order": ["far", "near", "mono"], "tau": 1.0}
    assert rankings["colmap"]["order"] == ["near", "far", "mono"]
    assert rankings["colmap"]["tau"] == pytest.approx(1 / 3)


def test_missing_predictions_never_help(lab: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    holed = {
        view: np.where(rng.random((HEIGHT, WIDTH)) < 0.2, np.nan, MONO_FACTOR * noisy(exact_depth(view), view))
        for view in range(VIEWS)
    }
    write_depths(tmp_path / "holed", holed)
    write_depths(tmp_path / "few", {view: depth_m for view, depth_m in holed.items() if view < VIEWS // 2})
    far = {view: np.where(exact_depth(view) > 2, 500, exact_depth(view)) for view in range(VIEWS)}
    write_depths(tmp_path / "far", far)
    result = run_lab(lab, tmp_path, "mono", *(tmp_path / name for name in ("holed", "few", "far")))
    present = np.mean([np.isfinite(depth_m).mean() for depth_m in holed.values()])
    row = row_of(result, "holed", "stereo")
    assert row["coverage"] == row["frame_share"] == pytest.approx(present)
    few = row_of(result, "few", "stereo")
    assert (few["views"], few["views_scored"], few["ranked"]) == (VIEWS, VIEWS // 2, False)
    assert few["coverage"] < 0.41
    out_of_range = np.mean([(depth_m < 20).mean() for depth_m in far.values()])
    assert row_of(result, "far", "stereo")["coverage"] == pytest.approx(out_of_range)
    assert result["rankings"]["stereo"]["native"]["order"] == ["mono"]


def test_depth_range_limits_scored_pixels(lab: Path, tmp_path: Path) -> None:
    z_m = np.stack([STEREO_FACTOR * exact_depth(view) for view in range(VIEWS)])
    result = run_lab(lab, tmp_path, "mono", options=("--near", "1", "--far", "2"))
    assert result["range_m"] == [1.0, 2.0]
    assert result["references"][0]["frame_share"] == pytest.approx(((z_m >= 1) & (z_m <= 2)).mean(), abs=1e-3)
    assert not row_of(result, "mono", "stereo")["ranked"]  # The prediction of 1.6 times 2 m is out of range.
    depths_m = np.array([[math.nan, math.inf, -math.inf, -1, 0, 0.49, 0.5, 10, 10.1]])
    assert np.isfinite(masked(depths_m, 0.5, 10.0)).tolist() == [[False] * 6 + [True, True, False]]
    just_below = np.full((1, 1), 0.1, np.float16)  # 0.09998
    assert np.isnan(masked(just_below, 0.1, 1.0)).all()


def test_equal_names_are_made_unique(lab: Path, tmp_path: Path) -> None:
    result = run_lab(lab, tmp_path, "mono", "mono", "stereo")
    methods = list(dict.fromkeys(row["method"] for row in result["rows"]))
    assert methods == ["mono (mono)", "mono (mono) #2", "stereo (stereo)"]
    assert [reference["name"] for reference in result["references"]] == ["stereo (stereo) #2", "colmap"]
    assert row_of(result, "stereo (stereo)", "stereo (stereo) #2")["native"]["abs_rel"] == 0
    # The error to divide by is zero.
    assert row_of(result, "stereo (stereo)", "colmap")["ratio"]["native"] is None


def test_agreement_of_references_without_common_pixels_is_undefined() -> None:
    found = agreement(("a", "b"), np.array([[1.0, math.nan]]), np.array([[math.nan, 2.0]]))
    assert (found["views"], found["common_share"]) == (False, 0.0)
    assert math.isnan(found["abs_rel"])


def test_dataset_folder_adds_exact_references(
    tiny_root: Path, tiny_truth: dict[str, Depth], archive_of: Callable[..., Path], tmp_path: Path
) -> None:
    mono = archive_of({view: MONO_FACTOR * entry for view, entry in tiny_truth.items()}, "mono.zip")
    stereo = archive_of({view: STEREO_FACTOR * entry for view, entry in tiny_truth.items()}, "stereo.zip")
    half = {view: COLMAP_FACTOR * entry * (np.arange(160) < 80) for view, entry in tiny_truth.items()}
    colmap = archive_of(half, "colmap.zip")
    options = ("--data", tiny_root, "--config", "lattice", "--near", "0.01", "--far", "100")
    result = result_of(pseudo_reference, tmp_path, mono, "--reference", stereo, colmap, *options)
    first, second, exact, on_first, on_second = (entry["name"] for entry in result["references"])
    assert [entry["exact"] for entry in result["references"]] == [False, False, True, True, True]
    factors = {first: STEREO_FACTOR, second: COLMAP_FACTOR, exact: 1, on_first: 1, on_second: 1}
    for name, factor in factors.items():
        row = row_of(result, "test (mono.zip)", name)
        assert row["native"]["abs_rel"] == pytest.approx(MONO_FACTOR / factor - 1, rel=1e-6), name
    shares = {entry["name"]: entry["frame_share"] for entry in result["references"]}
    assert shares[second] == shares[on_second] < shares[exact]
    pairs = [(entry["reference"], entry["against"]) for entry in result["agreement"]]
    assert pairs == [(first, second), (first, exact), (second, first), (second, exact)]
    assert result["dataset"]["digest"].startswith("sha256:")
    without = result_of(pseudo_reference, tmp_path, mono, "--reference", stereo, *options, "--no-exact")
    assert [entry["exact"] for entry in without["references"]] == [False]


def test_data_are_restricted_to_the_split_of_the_maps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = tmp_path / "dataset"
    write_split_dataset(root, {"a": "train", "b": "train", "c": "test"}, 3)
    for split, name, factor in (("train", "a", 1.25), ("train", "b", 1.0), ("test", "c", 1.0)):
        rows = rdb.load(root, "cages", split=split, columns=["view_id", "left_depth"])
        with rdb.SubmissionWriter(tmp_path / f"{name}.zip", name) as writer:
            for row in rows:
                writer.add(row["view_id"], row["left_depth"] * np.float32(factor))
    a, b, c = (tmp_path / f"{name}.zip" for name in "abc")
    result = result_of(pseudo_reference, tmp_path, a, "--reference", b, "--data", root)
    assert result["data"] == "config cages (train)"
    for row in result["rows"]:
        assert (row["views"], row["coverage"]) == (6, 1.0)
        assert row["native"]["abs_rel"] == pytest.approx(0.25)
    message = refusal(pseudo_reference, capsys, a, "--reference", c, "--data", root)
    assert "the splits of the maps are test, train, expected one" in message


@pytest.mark.slow
def test_names_of_methods_are_plain_text(lab: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, method in (("a.zip", "$\\frac$ [/]"), ("b.zip", "$")):
        with rdb.SubmissionWriter(tmp_path / name, method) as writer:
            for view in range(VIEWS):
                writer.add(f"zed/{view:06d}", exact_depth(view))
    methods = (tmp_path / "a.zip", tmp_path / "b.zip")
    written_files(pseudo_reference, tmp_path, *methods, "--reference", lab / "stereo", "--data", lab / "zed")
    printed = capsys.readouterr().out
    assert r"$\frac$" in printed
    assert all(line.isprintable() for line in printed.split("\n"))


@pytest.mark.slow
def test_outputs_are_deterministic(lab: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = (lab / "mono", lab / "other", "--reference", lab / "stereo", lab / "colmap", "--data", lab / "zed")
    files = repeated_files(pseudo_reference, tmp_path, *arguments, again=("--workers", "1"))
    content = json.loads(files["json"])
    assert (content["protocol"], content["dataset"]) == ("rebar-pseudo-reference-1", None)
    assert "baseline 119.98 mm" in content["camera"]
    assert [entry["method"] for entry in content["submissions"]] == ["mono", "other", "stereo", "colmap"]
    assert files["csv"].count(b"\n") == 5
    printed = capsys.readouterr().out
    assert "colmap, native: other < mono, tau 1.0" in printed
    assert "Depth Anything 3 Metric  31.6  0.62" in printed


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"--near": "500", "--far": "600"}, "no depth from 500 to 600 m"),
        ({"--near": "3", "--far": "2"}, "no depth from 3 to 2 m"),
        ({"--data": "nowhere"}, "nowhere: no such folder"),
        ({"--reference": "nothing.zip"}, "does not exist"),
        ({"--reference": "strange"}, "no depth file of any view was found"),
        ({"--workers": "-1"}, "workers is -1"),
    ],
)
def test_bad_input_exits_with_status_2(
    change: dict[str, str],
    words: str,
    lab: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    write_depths(tmp_path / "strange", {99: exact_depth(0)})
    options = {"--reference": str(lab / "stereo"), "--data": str(lab / "zed")} | change
    arguments = (part for pair in options.items() for part in pair)
    assert words in refusal(pseudo_reference, capsys, lab / "mono", *arguments)


DEPTH = np.linspace(0.5, 2.0, 12).reshape(3, 4).astype(np.float32)
MAPS = {"walk/a": (3, 4), "walk/b": (3, 4)}


def test_folder_reads_every_format(tmp_path: Path) -> None:
    units = np.round(DEPTH.astype(np.float64) * 1000)
    (tmp_path / "submission.json").write_text('{"method": "mine", "depth_scale": 0.001}')
    (tmp_path / "walk").mkdir()
    files: dict[str, Callable[[Path], object]] = {
        "a.npy": lambda path: np.save(path, DEPTH),
        "a.npz": lambda path: path.write_bytes(npz(depth=DEPTH)),
        "walk/a.exr": lambda path: exr(path, {"Z": DEPTH}),
        "a.png": lambda path: path.write_bytes(png(units)),
    }
    for name, write in files.items():
        path = tmp_path / name
        write(path)
        with open_maps(tmp_path, MAPS) as source:
            assert (source.method, source.view_ids) == ("mine", ("walk/a",))
            expected = units * 0.001 if name == "a.png" else DEPTH
            assert np.array_equal(source.read("walk/a"), expected), name
        path.unlink()


def test_folder_and_archive_are_read_alike(tmp_path: Path) -> None:
    archive, folder = tmp_path / "a.zip", tmp_path / "method-x"
    folder.mkdir()
    with rdb.SubmissionWriter(archive, method="method-y") as writer:
        for view_id in MAPS:
            writer.add(view_id, DEPTH)
            np.save(folder / f"{view_id.partition('/')[2]}.npy", DEPTH)
    with open_maps(archive, MAPS) as from_archive, open_maps(folder, MAPS) as from_folder:
        assert (from_archive.method, from_folder.method) == ("method-y", "method-x")
        assert from_archive.view_ids == from_folder.view_ids == tuple(MAPS)
        assert np.array_equal(from_archive.read("walk/b"), from_folder.read("walk/b"))
        before = from_folder.sha256
    np.save(folder / "b.npy", 2 * DEPTH)
    with open_maps(folder, MAPS) as changed:
        assert changed.sha256 != before


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({"c.npy": b""}, "no depth file of any view was found"),
        ({"a.npy": b"", "a.npz": b""}, r"walk/a has the files a\.npy, a\.npz, expected one"),
        ({"a.png": b""}, "expected their depth_scale"),
        ({"a.npy": b"", "submission.json": b"{"}, "submission.json"),
        ({"a.npy": b"none"}, r"a\.npy"),
    ],
)
def test_unusable_folder_is_refused(files: dict[str, bytes], words: str, tmp_path: Path) -> None:
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=words), open_maps(tmp_path, MAPS) as source:
        source.read("walk/a")
