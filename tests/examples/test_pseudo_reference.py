"""``study pseudo-reference`` on captures and on a rendered dataset: known scale, noise and gaps; bad input."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rebar_depth_bench.studies.pseudo_reference import command as study_module
from rebar_depth_bench.studies.pseudo_reference.command import run_pseudo_reference_study
from rebar_depth_bench.studies.pseudo_reference.result import PseudoReferenceResult, kendall_tau
from rebar_depth_bench.studies.pseudo_reference.study import DepthRange

from rebar_depth_bench.errors import InputError
from tests.bench.studies.captures import HEIGHT, VIEWS, WIDTH, Depth, exact_depth, write_capture, write_depths
from tests.bench.studies.commands import run_study

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


def run_lab(lab: Path, *methods: str, **options: Any) -> PseudoReferenceResult:
    references = [str(lab / name) for name in ("stereo", "colmap")]
    return run_pseudo_reference_study(
        [str(lab / name) for name in methods], references, str(lab / "zed"), **options
    )


def test_known_scale_and_noise_lie_within_intervals(lab: Path) -> None:
    result = run_lab(lab, "mono")
    samples = np.random.default_rng(0).standard_normal(1_000_000)
    for reference, factor, share in (("stereo", STEREO_FACTOR, 1.0), ("colmap", COLMAP_FACTOR, 0.5)):
        row = result.row("mono", reference)
        expected = {
            "scale_median": factor / MONO_FACTOR,
            "native.abs_rel": np.abs(MONO_FACTOR / factor * np.exp(NOISE * samples) - 1).mean(),
            "scaled.abs_rel": np.abs(np.exp(NOISE * samples) - 1).mean(),
        }
        for name, value in expected.items():
            low, high = row.table.intervals[name] or (0, 0)
            assert low < value < high, (reference, name)
            assert high - low < 0.05 * value
        assert row.frame_share == share
        assert row.table.coverage == 1.0
        assert row.table.is_comparable
    assert [entry.frame_share for entry in result.references] == [1.0, 0.5]
    agreements = {(entry.reference, entry.against): entry for entry in result.agreements}
    assert agreements["stereo", "colmap"].median_ratio == pytest.approx(STEREO_FACTOR / COLMAP_FACTOR)
    assert agreements["stereo", "colmap"].abs_rel == pytest.approx(STEREO_FACTOR / COLMAP_FACTOR - 1)
    assert agreements["colmap", "stereo"].abs_rel == pytest.approx(1 - COLMAP_FACTOR / STEREO_FACTOR)
    assert agreements["colmap", "stereo"].common_share == 0.5


def test_score_of_shifted_method_matches_plain_numpy(lab: Path) -> None:
    result = run_lab(lab, "other")
    views = []
    for view in range(VIEWS):
        z_m = (COLMAP_FACTOR * exact_depth(view)).astype(np.float32).astype(np.float64)[:, : WIDTH // 2].ravel()
        p_m = (
            (OTHER_FACTOR * exact_depth(view) + 0.2).astype(np.float32).astype(np.float64)[:, : WIDTH // 2].ravel()
        )
        s = np.median(z_m) / np.median(p_m)
        views.append(
            (
                np.mean(np.abs(p_m - z_m) / z_m),
                100 * np.sqrt(np.mean((p_m - z_m) ** 2)),
                np.mean(np.abs(s * p_m - z_m) / z_m),
                s,
            )
        )
    table = result.row("other", "colmap").table
    assert table.native is not None
    assert table.scaled is not None
    scored = (table.native.abs_rel, table.native.rmse_cm, table.scaled.abs_rel)
    assert scored == pytest.approx(tuple(np.mean(views, axis=0)[:3]), rel=1e-6)
    assert table.scale_median == pytest.approx(np.median([values[3] for values in views]), rel=1e-6)


def test_ratios_and_rankings_follow_rows(lab: Path) -> None:
    result = run_lab(lab, "mono", "other")
    rows = {(row.method, row.reference): row.table for row in result.rows}
    for method in ("mono", "other"):
        natives = [rows[method, reference].native for reference in ("stereo", "colmap")]
        assert natives[0] is not None
        assert natives[1] is not None
        assert result.ratio(method, "colmap", "native") == natives[1].abs_rel / natives[0].abs_rel
        assert result.ratio(method, "stereo", "native") == 1
    # mono is 1.57 or 1.78 times too far, other 0.6 to 0.9 times the reference: other is better in both.
    assert result.ranking("stereo", "native") == result.ranking("colmap", "native") == ("other", "mono")
    assert result.tau("colmap", "native") == 1


def test_changed_ranking_gives_negative_tau(lab: Path, tmp_path: Path) -> None:
    for name, factor in (("near", 0.93), ("far", 1.05)):
        write_depths(tmp_path / name, {view: factor * exact_depth(view) for view in range(VIEWS)})
    result = run_lab(lab, str(tmp_path / "near"), str(tmp_path / "far"))
    assert result.ranking("stereo", "native") == ("far", "near")
    assert result.ranking("colmap", "native") == ("near", "far")
    assert result.tau("colmap", "native") == -1


def test_missing_predictions_never_help(lab: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    holed = {
        view: np.where(rng.random((HEIGHT, WIDTH)) < 0.2, np.nan, MONO_FACTOR * noisy(exact_depth(view), view))
        for view in range(VIEWS)
    }
    write_depths(tmp_path / "holed", holed)
    write_depths(tmp_path / "few", {view: depth_m for view, depth_m in holed.items() if view < VIEWS // 2})
    far = {
        view: np.where(depth_m > 2, 500, depth_m) for view, depth_m in ((v, exact_depth(v)) for v in range(VIEWS))
    }
    write_depths(tmp_path / "far", far)
    result = run_lab(lab, "mono", *(str(tmp_path / name) for name in ("holed", "few", "far")))
    present = np.mean([np.isfinite(depth_m).mean() for depth_m in holed.values()])
    row = result.row("holed", "stereo")
    assert row.table.coverage == pytest.approx(present)
    assert row.frame_share == pytest.approx(present)
    few = result.row("few", "stereo").table
    assert (few.views, few.views_scored, few.is_comparable) == (VIEWS, VIEWS // 2, False)
    assert few.coverage is not None
    assert few.coverage < 0.41
    out_of_range = result.row("far", "stereo").table
    assert out_of_range.coverage == pytest.approx(np.mean([(depth_m < 20).mean() for depth_m in far.values()]))
    assert result.ranking("stereo", "native") == ("mono",)


def test_depth_range_limits_scored_pixels(lab: Path) -> None:
    z_m = np.stack([STEREO_FACTOR * exact_depth(view) for view in range(VIEWS)])
    result = run_lab(lab, "mono", depth_range=DepthRange(1.0, 2.0))
    inside = ((z_m >= 1) & (z_m <= 2)).mean()
    assert result.references[0].frame_share == pytest.approx(inside, abs=1e-3)
    assert result.row("mono", "stereo").table.coverage is not None
    assert not result.row("mono", "stereo").table.is_comparable  # The prediction of 1.6 times 2 m is out of range.


def test_views_without_reference_are_not_counted(lab: Path, tmp_path: Path) -> None:
    write_depths(tmp_path / "half", {view: STEREO_FACTOR * exact_depth(view) for view in range(0, VIEWS, 2)})
    result = run_pseudo_reference_study([str(lab / "mono")], [str(tmp_path / "half")], str(lab / "zed"))
    (reference,) = result.references
    assert (reference.views, reference.views_with, reference.frame_share) == (VIEWS, VIEWS // 2, 0.5)
    row = result.row("mono", "half")
    assert (row.table.views, row.table.is_comparable, row.frame_share) == (VIEWS // 2, True, 0.5)


def test_equal_names_are_made_unique(lab: Path) -> None:
    result = run_lab(lab, "mono", "mono", "stereo")
    assert result.methods == ("mono (mono)", "mono (mono) #2", "stereo (stereo)")
    assert [reference.name for reference in result.references] == ["stereo (stereo) #2", "colmap"]
    native = result.row("stereo (stereo)", "stereo (stereo) #2").table.native
    assert native is not None
    assert native.abs_rel == 0
    assert result.ratio("stereo (stereo)", "colmap", "native") is None  # The error to divide by is zero.


def test_result_is_independent_of_worker_count(lab: Path) -> None:
    assert run_lab(lab, "mono", "other", workers=1) == run_lab(lab, "mono", "other", workers=3)


def test_dataset_folder_adds_exact_references(
    tiny_root: Path, tiny_truth: dict[str, Depth], archive_of: Callable[..., Path]
) -> None:
    mono = archive_of({view: MONO_FACTOR * entry for view, entry in tiny_truth.items()}, "mono.zip")
    stereo = archive_of({view: STEREO_FACTOR * entry for view, entry in tiny_truth.items()}, "stereo.zip")
    colmap = archive_of(
        {view: COLMAP_FACTOR * entry * (np.arange(160) < 80) for view, entry in tiny_truth.items()}, "colmap.zip"
    )
    options = {"config": "lattice", "depth_range": DepthRange(0.01, 100)}
    result = run_pseudo_reference_study([str(mono)], [str(stereo), str(colmap)], str(tiny_root), **options)  # type: ignore[arg-type]
    first, second, exact, on_first, on_second = (entry.name for entry in result.references)
    assert [entry.exact for entry in result.references] == [False, False, True, True, True]
    method = result.methods[0]
    natives = {name: result.row(method, name).table.native for name in (first, second, exact, on_first, on_second)}
    expected = {
        first: MONO_FACTOR / STEREO_FACTOR - 1,
        second: MONO_FACTOR / COLMAP_FACTOR - 1,
        exact: 0.6,
        on_first: 0.6,
        on_second: 0.6,
    }
    for name, value in expected.items():
        metrics = natives[name]
        assert metrics is not None
        assert metrics.abs_rel == pytest.approx(value, rel=1e-6), name
    shares = {entry.name: entry.frame_share for entry in result.references}
    assert shares[second] == shares[on_second] < shares[exact]
    assert {(entry.reference, entry.against) for entry in result.agreements} == {
        *((first, second), (second, first), (first, exact), (second, exact))
    }
    assert result.provenance.dataset_digest is not None
    without = run_pseudo_reference_study([str(mono)], [str(stereo)], str(tiny_root), exact=False, **options)  # type: ignore[arg-type]
    assert len(without.references) == 1


def test_command_writes_json_csv_and_html(lab: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = {kind: tmp_path / f"out.{kind}" for kind in ("json", "csv", "html")}
    output_options = [part for kind, path in files.items() for part in (f"--{kind}", path)]
    arguments = (lab / "mono", lab / "other", "--reference", lab / "stereo", lab / "colmap", "--data", lab / "zed")
    assert run_study(study_module, *arguments, *output_options) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "native (no alignment) and scaled (oracle median scale per view), depths of 0.1 to 20 m" in out
    assert "baseline 119.98 mm" in out
    assert "No exact depth is available" in out
    assert "0.62" in out  # Published in Table II.
    content = json.loads(files["json"].read_text())
    assert content["protocol"] == "rebar-pseudo-reference-1"
    assert content["dataset"] is None
    assert content["range_m"] == [0.1, 20.0]
    assert [entry["method"] for entry in content["submissions"]] == ["mono", "other", "stereo", "colmap"]
    rows = list(csv.DictReader(files["csv"].read_text().splitlines()))
    assert [(row["method"], row["reference"]) for row in rows][:2] == [("mono", "stereo"), ("other", "stereo")]
    assert float(rows[0]["native_abs_rel"]) == content["rows"][0]["native"]["abs_rel"]
    assert "ranking unchanged" in files["html"].read_text()
    before = [path.read_bytes() for path in files.values()]
    assert run_study(study_module, *arguments, *output_options, "--workers", "1") == 0
    assert [path.read_bytes() for path in files.values()] == before


def damage_depths(folder: Path) -> None:
    (folder / "000001.npy").write_bytes(b"none")
    np.save(folder / "000002.npy", np.ones((HEIGHT, WIDTH + 1)))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"--near": "3", "--far": "2"}, "the range is 3.0 to 2.0 m, expected 0 <= near < far"),
        (
            {"--near": "500", "--far": "600"},
            "no pixel of any view is 500 to 600 m, expected",
        ),
        ({"--data": "nowhere"}, "nowhere: no such folder"),
        ({"--config": "lattice"}, "is a capture, expected no --config (found 'lattice')"),
        ({"--reference": "nothing.zip"}, "does not exist"),
        ({"--reference": "strange"}, "no depth file of any view was found, expected <view_id>"),
        ({"--reference": "damaged"}, "2 problems"),
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
    damage_depths(write_depths(tmp_path / "damaged", {view: exact_depth(view) for view in range(VIEWS)}))
    options = {"--reference": str(lab / "stereo"), "--data": str(lab / "zed")} | change
    assert run_study(study_module, lab / "mono", *(part for pair in options.items() for part in pair)) == 2
    printed = capsys.readouterr()
    assert words in printed.err
    assert printed.out == ""


def test_dataset_of_several_configs_needs_config_option(tiny_root: Path, lab: Path) -> None:
    with pytest.raises(InputError, match="has 2 configs, expected --config with one of lattice, lattice-orbit"):
        run_pseudo_reference_study([str(lab / "mono")], [str(lab / "stereo")], str(tiny_root))


def test_kendall_tau_of_known_rankings() -> None:
    assert kendall_tau("abcd", "abcd") == 1
    assert kendall_tau("abcd", "dcba") == -1
    assert kendall_tau("abcd", "bacd") == (5 - 1) / 6
    assert kendall_tau("abx", "yba") == -1  # Only a and b are in both.
    assert kendall_tau("a", "a") is None
