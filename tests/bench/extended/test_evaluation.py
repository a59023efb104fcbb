"""Extended measures of archives of a rendered dataset, from the folder to JSON, CSV, terminal and report."""

from __future__ import annotations

import csv
import io
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from rebar_depth_bench import DatasetError, SubmissionWriter, load, score
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.data.bars import bars, read_bars, write_bars
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.extended.estimates import ExtendedResult
from rebar_depth_bench.extended.families import MEASURE_FAMILIES, measures_by_alignment
from rebar_depth_bench.extended.ground_truth import dilate_mask, load_steel_truth
from rebar_depth_bench.extended.measures import EXTENDED_PROTOCOL, NATIVE, ONCE, SCALED, Measure
from rebar_depth_bench.extended.published import image_boundary_samples
from rebar_depth_bench.reporting.extended_tables import print_extended
from rebar_depth_bench.scoring.protocol import scored_pixels
from rebar_depth_bench.submission import SubmissionReader
from tests.bench.extended.thin_scenes import steel_truth

Depths = dict[str, np.ndarray]
Archive = Callable[..., Path]


def extended(archive: Path, root: Path, workers: int = 2) -> ExtendedResult:
    result = score(archive, root, extended=True, workers=workers).extended
    assert result is not None
    return result


def values(result: ExtendedResult, alignment: str) -> dict[str, float]:
    numbers = result.tables["lattice"].numbers[alignment]
    return {name: estimate.value for name, estimate in numbers.items() if estimate.value is not None}


@pytest.fixture(scope="module")
def archive_of_truth(tiny_truth: Depths, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("truth") / "truth.zip"
    with SubmissionWriter(path, method="test") as writer:
        for view_id, depth_m in tiny_truth.items():
            writer.add(view_id, depth_m)
    return path


@pytest.fixture(scope="module")
def of_truth(archive_of_truth: Path, tiny_root: Path) -> ExtendedResult:
    return extended(archive_of_truth, tiny_root)


def test_measures_have_names_titles_and_definitions_of_their_own() -> None:
    for measures in measures_by_alignment().values():
        names = {measure.name for measure in measures}
        assert len(names) == len({measure.title for measure in measures}) == len(measures)
        assert not {"abs_rel", "rmse_cm", "mae_cm", "delta1", "coverage"} & names
        assert all(measure.definition for measure in measures)


def test_ground_truth_is_perfect_in_every_measure(of_truth: ExtendedResult) -> None:
    once, native = values(of_truth, ONCE), values(of_truth, NATIVE)
    assert values(of_truth, SCALED).items() <= native.items()
    assert once["scale_spread"] == 0.0
    for name in once:
        if name.startswith(("silog", "boundary")):
            ideal = 1.0 if name in ("boundary_f1", "boundary_precision", "boundary_recall") else 0.0
            assert once[name] == pytest.approx(ideal, abs=1e-9), name
    for family in ("single_bar", "clouds", "disparity"):
        for measure in MEASURE_FAMILIES[family].measures:
            if measure.name in native and measure.better:
                assert native[measure.name] == (1.0 if measure.better == "higher" else 0.0), measure.name
    assert all(value == 0 for name, value in native.items() if "abs_rel" in name)
    assert not {measure.name for measure in MEASURE_FAMILIES["as_built"].measures} & native.keys()
    console = Console(width=100, record=True, file=io.StringIO())
    print_extended(of_truth, console)
    text = console.export_text()
    shown = {key for key, family in MEASURE_FAMILIES.items() if family.title in text}
    assert shown == MEASURE_FAMILIES.keys() - {"as_built", "crossings"}, "without a design, and small"


def printed_rows(of_truth: ExtendedResult, family: str = "") -> list[str]:
    console = Console(width=300, record=True, file=io.StringIO())
    print_extended(of_truth, console, family)
    return [line.rstrip() for line in console.export_text().splitlines()]


def test_terminal_prints_the_first_rows_of_families_or_one_whole(of_truth: ExtendedResult) -> None:
    short = printed_rows(of_truth)
    for key, family in MEASURE_FAMILIES.items():
        whole = printed_rows(of_truth, key)
        shown = [one for one in MEASURE_FAMILIES.values() if one.title in whole]
        assert shown == ([family] if key not in ("as_built", "crossings") else [])
        known = {
            measure.column.heading
            for measure in family.measures
            for alignment in family.alignments
            if of_truth.tables["lattice"].numbers[alignment][measure.name].value is not None
        }
        rows = {name for name in known if any(line.startswith(f"  {name} ") for line in whole)}
        assert rows == known
        hidden = f"  and {len(known) - 3} more: --family {key}"
        assert (hidden in short) == (len(known) > 3)


def test_doubled_depth_is_corrected_by_scale(
    tiny_truth: Depths, tiny_root: Path, archive_of: Archive, of_truth: ExtendedResult
) -> None:
    result = extended(archive_of({view: 2 * depth for view, depth in tiny_truth.items()}), tiny_root)
    once = values(result, ONCE)
    assert once["scale_spread"] == pytest.approx(0, abs=1e-12)
    assert values(result, SCALED) == values(of_truth, SCALED)


@pytest.mark.slow
def test_predictions_are_read_once_and_the_number_of_workers_changes_nothing(
    tiny_truth: Depths, tiny_root: Path, archive_of: Archive, monkeypatch: pytest.MonkeyPatch
) -> None:
    original, views = SubmissionReader.read, []

    def read(reader: SubmissionReader, view_id: str) -> np.ndarray:
        views.append(view_id)
        return original(reader, view_id)

    archive = archive_of({view: 1.05 * depth + np.float32(0.002) for view, depth in tiny_truth.items()})
    four_workers = extended(archive, tiny_root, workers=4).to_dict()
    monkeypatch.setattr(SubmissionReader, "read", read)
    one_worker = extended(archive, tiny_root, workers=1).to_dict()
    assert json.dumps(one_worker) == json.dumps(four_workers)
    assert sorted(views) == sorted(tiny_truth)


def test_steel_truth_matches_dataset_folder(tiny_root: Path, tiny_truth: Depths, tiny_masks: Depths) -> None:
    folder = open_folder(tiny_root)
    steel = load_steel_truth(folder, folder.config("lattice"))
    assert len(steel) == len(tiny_truth)
    for number in range(len(steel)):
        view = steel.view(number)
        depth_m, mask = tiny_truth[view.view_id], tiny_masks[view.view_id]
        assert np.array_equal(view.index, np.flatnonzero(dilate_mask(mask) & (depth_m > 0)))
        assert np.array_equal(view.bar_id > 0, mask.ravel()[view.index])
        assert np.array_equal(view.depth_m, depth_m.ravel()[view.index])
        # Pixels without steel show the board: rays and pose map them to z = 0.
        camera_m = view.depth_m[:, None] * np.column_stack([view.rays, np.ones(len(view.rays))])
        world_m = (camera_m - view.cam_from_world[:3, 3]) @ view.cam_from_world[:3, :3]
        assert abs(np.median(world_m[view.bar_id == 0, 2])) < 1e-6


def test_dilate_mask_by_hand() -> None:
    mask = np.zeros((4, 5), dtype=bool)
    mask[0, 0] = mask[2, 3] = True
    expected = ["11...", "11111", "..111", "..111"]
    assert ["".join("1" if cell else "." for cell in row) for row in dilate_mask(mask)] == expected


def test_disparity_and_boundary_of_whole_images_follow_from_the_rows(tiny_root: Path, archive_of: Archive) -> None:
    """Numbers of views, from the archive to the result, are those of the depth of both views in the rows."""
    rows = {row["view_id"]: row for row in load(tiny_root, "lattice")}
    predicted = {view: np.roll(row["left_depth"], 1, axis=1) * np.float32(0.99) for view, row in rows.items()}
    result = extended(archive_of(predicted), tiny_root)
    for view_id, row in rows.items():
        z_m, p_m = row["left_depth"].astype(np.float64), predicted[view_id].astype(np.float64)
        truth = steel_truth(row["left_depth"], row["left_bars"])
        expected = image_boundary_samples(np.where(p_m > 0, p_m, np.nan), truth)
        assert {name: result.views[view_id][ONCE][name] for name in expected} == {
            name: float(values[0]) for name, values in expected.items()
        }
        parallax_px_m = row["left_K"][0, 0] * row["baseline_m"]
        v, u = np.divmod(scored_pixels(row["left_mask"], row["left_depth"]).astype(int), z_m.shape[1])
        d = parallax_px_m / z_m[v, u]
        match = np.round(u - d).astype(int)
        inside = match >= 0
        right_m = np.where(inside, row["right_depth"][v, np.where(inside, match, 0)], 0).astype(np.float64)
        with np.errstate(divide="ignore"):
            seen = (right_m > 0) & (np.abs(parallax_px_m / right_m - d) <= 1)
        error = np.abs(parallax_px_m / p_m[v, u] - d)
        numbers = result.views[view_id][NATIVE]
        assert numbers["disparity_seen_by_right"] == pytest.approx(seen.mean())
        assert numbers["disparity_epe_px"] == pytest.approx(error.mean())
        assert numbers["disparity_noc_epe_px"] == pytest.approx(error[seen].mean())
        assert numbers["disparity_noc_bad2"] == pytest.approx((error[seen] > 2).mean())
        assert numbers["disparity_d1"] == pytest.approx(((error > 3) & (error > 0.05 * d)).mean())


@pytest.mark.slow
def test_score_command_writes_extended_json_and_csv(
    tiny_truth: Depths, tiny_root: Path, archive_of_truth: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    archive = archive_of_truth
    out, table = tmp_path / "out.json", tmp_path / "out.csv"
    command = ["score", str(archive), "--data", str(tiny_root), "--json", str(out), "--extended-csv", str(table)]
    assert main(command) == 0
    content = json.loads(out.read_text())
    plain = score(archive, tiny_root).to_dict()
    assert {key: value for key, value in content.items() if key != "extended"} == plain
    assert content["extended"]["protocol"] == EXTENDED_PROTOCOL
    assert len(content["extended"]["views"]) == len(tiny_truth)
    rows = list(csv.DictReader(io.StringIO(table.read_text())))
    assert len(rows) == sum(map(len, measures_by_alignment().values()))
    assert {row["submission_sha256"] for row in rows} == {plain["submission"]["sha256"]}
    f1 = next(row for row in rows if row["measure"] == "boundary_f1")
    assert float(f1["value"]) == 1.0
    assert "Boundary" in capsys.readouterr().out
    command = ["score", str(archive), "--data", str(tiny_root), "--family"]
    assert main([*command, "clouds"]) == 0
    shown = capsys.readouterr().out
    assert MEASURE_FAMILIES["clouds"].title in shown
    assert "Boundary" not in shown
    assert main([*command, "cloud"]) == 2
    assert f"--family is cloud, expected one of {', '.join(MEASURE_FAMILIES)}" in capsys.readouterr().err


def test_missing_and_damaged_bars_are_refused(tiny_root: Path, archive_of_truth: Path, tmp_path: Path) -> None:
    """Bars that contradict the manifest are not used, since they would change the measures."""
    copy = tmp_path / "copy"
    shutil.copytree(tiny_root, copy)
    scenes = read_bars(copy / "bars.parquet")
    scene, (bar, *others) = next(iter(scenes.items()))
    write_bars(copy / "bars.parquet", {**scenes, scene: (replace(bar, diameter_m=2 * bar.diameter_m), *others)})
    with pytest.raises(DatasetError, match=r"bars\.parquet: the SHA-256 is"):
        score(archive_of_truth, copy, extended=True)
    with pytest.raises(DatasetError, match=r"bars\.parquet: the SHA-256 is"):
        bars(copy)
    (copy / "bars.parquet").unlink()
    expected = r"has no bars\.parquet, expected a complete dataset folder written by rebar-build"
    with pytest.raises(DatasetError, match=expected):
        score(archive_of_truth, copy, extended=True)


def test_shares_of_frames_are_from_0_to_1_without_a_unit(of_truth: ExtendedResult) -> None:
    units = {one.name: one.unit for measures in measures_by_alignment().values() for one in measures}
    frame = of_truth.to_sheet().to_pandas()
    unit = frame["measure"].map(units)
    shares = frame[unit == "%"]
    assert set(shares["unit"]) == {""}
    assert shares["value"].dropna().between(0, 1).all()
    assert shares["value"].max() == 1
    assert (frame["unit"] == unit.replace("%", "")).all()


def test_measure_of_an_unknown_statistic_or_unit_is_refused() -> None:
    for arguments, words in ((("mm", "", "d", "s", "p90"), "new: got 'p90', expected"), (("km", "", "d"), "'km'")):
        with pytest.raises(ValueError, match=words):
            Measure("new", "New", *arguments)
