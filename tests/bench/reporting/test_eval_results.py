"""Rank errors as ``.eval_results`` entries of the Hub, read back with the Hub's own parser."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from huggingface_hub import EvalResultEntry, parse_eval_result_entries

import rebar_depth_bench as rdb
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.data.manifest import DatasetFolder, open_folder
from rebar_depth_bench.errors import InputError
from rebar_depth_bench.reporting.eval_results import check_hub_id, eval_results, yaml_text
from rebar_depth_bench.scoring.rounding import rounded
from rebar_depth_bench.submission.metadata import Declaration
from tests.bench.reporting.results import HOSTILE, result, scored_view

ArchiveOf = Callable[..., Path]
HUB_ID = "org/rebar"
COMMIT = "5503434ddd753f426f4b38109466949a1217c2bb"


def entries_of(text: str) -> list[EvalResultEntry]:
    return parse_eval_result_entries(yaml.safe_load(text))


@pytest.fixture
def folder(tiny_root: Path) -> DatasetFolder:
    return open_folder(tiny_root)


def test_score_writes_an_entry_per_config(
    tiny_root: Path, archive_of: ArchiveOf, tmp_path: Path, tiny_truth: dict[str, np.ndarray]
) -> None:
    orbit = {row["view_id"]: row["left_depth"] for row in rdb.load(tiny_root, "lattice-orbit")}
    predictions = {view: 1.25 * depth for view, depth in {**tiny_truth, **orbit}.items()}
    archive, out = archive_of(predictions), tmp_path / "new" / ".eval_results" / "rebar.yaml"
    command = ["score", str(archive), "--data", str(tiny_root), "--eval-results", str(out), "--hub-id", HUB_ID]
    assert main(command) == 0
    scored = rdb.score(archive, tiny_root)
    entries = entries_of(out.read_text())
    assert [(entry.dataset_id, entry.task_id, entry.value) for entry in entries] == [
        (HUB_ID, name, rounded(table.rank_error)) for name, table in scored.tables.items()
    ]
    assert [entry.value for entry in entries] == pytest.approx([0.2, 0.2], rel=1e-6)
    for entry in entries:
        assert entry.dataset_revision is entry.date is entry.source_url is None
        words = ("test", "rebar-2", scored.software_version, scored.dataset_digest[:19], "inputs: not declared")
        assert all(word in str(entry.notes) for word in words)
    tasks = yaml.safe_load((tiny_root / "eval.yaml").read_text())["tasks"]
    assert [entry.task_id for entry in entries] == [task["id"] for task in tasks]
    assert [path.name for path in out.parent.iterdir()] == [out.name]
    before = out.read_bytes()
    assert main(command) == 0
    assert out.read_bytes() == before


@pytest.mark.parametrize(
    ("root", "hub_id", "revision"),
    [(HUB_ID, HUB_ID, COMMIT), (f"{HUB_ID}@v1", HUB_ID, COMMIT), (f"{HUB_ID}@v1", "org/mirror", None)],
)
def test_revision_is_the_commit_of_the_same_repository(
    root: str, hub_id: str, revision: str | None, folder: DatasetFolder
) -> None:
    remote = folder.model_copy(update={"root": root, "commit": COMMIT})
    text, _ = eval_results(result(scored_view("lattice/0000")), remote, hub_id)
    assert [entry.dataset_revision for entry in entries_of(text)] == [revision]


@pytest.mark.parametrize(
    "hub_id", [None, "", "rebar", "a/b/c", f"{HUB_ID}@v1", "org/", "-org/x", "a/x--y", "a\n/b"]
)
def test_missing_or_invalid_id_is_refused_before_scoring(
    hub_id: str | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(InputError, match="--hub-id"):
        check_hub_id(hub_id)
    out = tmp_path / "rebar.yaml"
    options = [] if hub_id is None else [f"--hub-id={hub_id}"]
    assert main(["score", "nowhere.zip", "--data", "nowhere", "--eval-results", str(out), *options]) == 2
    stderr = capsys.readouterr().err
    assert "--hub-id" in stderr
    assert "nowhere" not in stderr
    assert not out.exists()


def test_id_without_file_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["score", "nowhere.zip", "--data", "nowhere", "--hub-id", HUB_ID]) == 2
    assert "--eval-results" in capsys.readouterr().err


def test_unranked_configs_are_left_out_with_a_note(folder: DatasetFolder) -> None:
    scores = result(scored_view("lattice/0000"), scored_view("mine/0000"))
    unranked = replace(scores.tables["mine"], ranked=False, views=0, rank_error=None)
    text, notes = eval_results(replace(scores, tables={**scores.tables, "mine": unranked}), folder, HUB_ID)
    assert [entry.task_id for entry in entries_of(text)] == ["lattice"]
    assert len(notes) == 1
    assert notes[0].startswith("mine ")


@pytest.mark.parametrize("split", ["train", "validation"])
def test_other_splits_than_that_of_the_task_are_left_out(split: str, folder: DatasetFolder) -> None:
    scores = result(scored_view("lattice/0000"), scored_view(f"cages/{split}-a-0000"))
    tables = {**scores.tables, "cages": replace(scores.tables["cages"], split=split)}
    text, notes = eval_results(replace(scores, tables=tables), folder, HUB_ID)
    assert [entry.task_id for entry in entries_of(text)] == ["lattice"]
    assert [note.partition(" ")[0] for note in notes] == ["cages"]
    with pytest.raises(InputError, match=split):
        eval_results(replace(scores, tables={"cages": tables["cages"]}), folder, HUB_ID)


def test_submission_that_uses_ground_truth_has_no_file(
    tiny_root: Path, tiny_truth: dict[str, np.ndarray], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    archive, out, table = tmp_path / "a.zip", tmp_path / "rebar.yaml", tmp_path / "table.csv"
    with rdb.SubmissionWriter(archive, method="oracle", uses_ground_truth=True) as writer:
        for view_id, depth_m in tiny_truth.items():
            writer.add(view_id, depth_m)
    command = ["score", str(archive), "--data", str(tiny_root), "--csv", str(table)]
    assert main([*command, "--eval-results", str(out), "--hub-id", HUB_ID]) == 2
    stderr = capsys.readouterr().err
    assert "no ranked config" in stderr
    assert "lattice is left out" in stderr
    assert "ground truth" in stderr
    assert not out.exists()
    assert not table.exists()


@pytest.mark.parametrize(
    "method",
    [
        HOSTILE,
        "- a: b # no comment\n",
        "{a: [*x, &y]} !!python/object:os.system |",
        "'\"\\ %TAG @ ` ? : ,",
        "yes",
        "1e3",
        "\x00\x07\x1b\x7f\x85\u2028\ufeff\ufffe",
        "\U0001f3d7 Bewehrung 鉄筋 " * 12,
    ],
)
def test_method_names_round_trip(method: str, folder: DatasetFolder) -> None:
    scores = result(scored_view("lattice/0000"), method=method, declared=Declaration())
    text, _ = eval_results(scores, folder, HUB_ID)
    [entry] = entries_of(text)
    assert str(entry.notes).startswith(f"{method}: rank error")
    assert text.encode().decode() == text


@pytest.mark.parametrize(
    "text", ["1e3", "0o17", "1_000", "12:30", "y", "no", "null", "~", "2026-11-23", "", " ", "-"]
)
def test_texts_stay_texts_in_every_version_of_yaml(text: str) -> None:
    assert yaml.safe_load(yaml_text([text])) == [text]
    assert yaml_text([text]).strip() in (f'- "{text}"', f"- '{text}'")
