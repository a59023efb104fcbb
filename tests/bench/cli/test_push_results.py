"""``rebar-bench push-results``: evaluation results in the repository of a model, on a Hub on this machine."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")

import yaml
from huggingface_hub import constants, parse_eval_result_entries
from starlette.responses import JSONResponse

from rebar_depth_bench.cli.main import main
from tests.commands import run_in_process
from tests.hub_server import READ_TOKEN, TOKEN, HubServer, StoredRepository

MODEL_ID = "org/model"
KEY = f"models/{MODEL_ID}"
RESULTS = """\
- dataset:
    id: org/rebar
    task_id: lattice
  value: 0.25
  notes: "my-method: rank error of protocol rebar-2, lower is better"
- dataset:
    id: org/rebar
    task_id: pile
    revision: 5503434ddd753f426f4b38109466949a1217c2bb
  value: 0.5
  date: 2026-11-23
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "rebar.yaml"
    path.write_text(RESULTS)
    return path


@pytest.fixture
def model(hub: HubServer) -> StoredRepository:
    return hub.add(KEY, {"README.md": b"a model", "model.safetensors": b"weights"})


def push(*arguments: str | Path, model_id: str = MODEL_ID) -> subprocess.CompletedProcess[str]:
    finished = run_in_process(main, "push-results", *arguments, "--model-id", model_id)
    output = finished.stdout + finished.stderr
    assert TOKEN not in output
    assert "Traceback" not in output
    return finished


def test_dry_run_shows_the_results_and_writes_nothing(hub: HubServer, model: StoredRepository, file: Path) -> None:
    finished = push(file)
    assert finished.returncode == 0
    assert "rebar.yaml: org/rebar, lattice: 0.25\n" in finished.stdout
    assert f"new      .eval_results/rebar.yaml, {len(RESULTS)} bytes\n" in finished.stdout
    assert "--yes" in finished.stdout
    assert hub.written() == []


def test_results_are_added_beside_the_other_files_of_the_model(
    hub: HubServer, model: StoredRepository, file: Path
) -> None:
    before = model.files()
    finished = push(file, "--yes")
    assert finished.returncode == 0, finished.stderr
    assert model.files() == {**before, ".eval_results/rebar.yaml": RESULTS.encode()}
    assert finished.stdout.splitlines()[-1].endswith(f"/commit/{model.branches['main']}")
    entries = parse_eval_result_entries(yaml.safe_load(model.files()[".eval_results/rebar.yaml"]))
    assert [entry.value for entry in entries] == [0.25, 0.5]
    hub.requests.clear()
    assert "up to date" in push(file, "--yes").stdout
    assert hub.written() == []
    file.write_text(RESULTS.replace("0.25", "0.125"))
    assert "changed  .eval_results/rebar.yaml" in push(file, "--yes").stdout
    assert b"0.125" in model.files()[".eval_results/rebar.yaml"]


def test_several_files_become_one_pull_request(model: StoredRepository, file: Path, tmp_path: Path) -> None:
    (other := tmp_path / "other.yaml").write_text(RESULTS)
    before = model.files()
    finished = push(file, other, "--yes", "--create-pr")
    assert finished.returncode == 0, finished.stderr
    assert model.files() == before
    assert set(model.files("refs/pr/1")) - set(before) == {".eval_results/rebar.yaml", ".eval_results/other.yaml"}
    assert finished.stdout.splitlines()[-1].endswith("/discussions/1")


@pytest.mark.parametrize(
    ("content", "codes"),
    [
        ("", ["invalid"]),
        ("a: [", ["syntax"]),
        ("\x00", ["syntax"]),
        ("[" * 5000, ["syntax"]),
        ("value: 0.5", ["invalid"]),
        ("[1, {}, {error: no, filename: x}]", ["invalid", "invalid", "invalid"]),
        (RESULTS.replace("0.25", ".nan"), ["invalid"]),
        (RESULTS.replace("0.25", "1" + 400 * "0"), ["invalid"]),
        (RESULTS.replace("0.25", "true"), ["invalid"]),
        (RESULTS.replace("org/rebar", "rebar"), ["invalid", "invalid"]),
        (RESULTS.replace("task_id: pile", "task_id: [&a [x, x], *a, *a]"), ["invalid"]),
        (RESULTS.replace("pile", "lattice"), ["duplicate"]),
    ],
)
def test_files_that_are_no_results_are_refused_before_any_request(
    hub: HubServer, file: Path, content: str, codes: list[str]
) -> None:
    file.write_text(content)
    finished = push(file, "--yes")
    assert finished.returncode == 2
    assert f"{file}: {len(codes)} problem" in finished.stderr
    assert hub.requests == []


def test_names_and_ids_that_are_not_valid_are_refused_before_any_request(
    hub: HubServer, file: Path, tmp_path: Path
) -> None:
    (tmp_path / "folder").mkdir()
    for name in ("results.json", ".yaml", "a b.yaml", "folder/rebar.yaml"):
        (tmp_path / name).write_text(RESULTS)
    for names in (
        ["results.json"],
        [".yaml"],
        ["a b.yaml"],
        ["nowhere.yaml"],
        ["rebar.yaml", "folder/rebar.yaml"],
    ):
        assert push(*(tmp_path / name for name in names), "--yes").returncode == 2
    for model_id in ("model", "a/b/c", "org/model@v1"):
        finished = push(file, "--yes", model_id=model_id)
        assert finished.returncode == 2
        assert "--model-id" in finished.stderr
    assert hub.requests == []


def test_missing_model_token_or_permission_is_refused(
    hub: HubServer, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    finished = push(file, "--yes")
    assert finished.returncode == 2
    assert "does not exist" in finished.stderr
    hub.add(KEY)
    for token in (f"{TOKEN}x", READ_TOKEN, ""):
        monkeypatch.setenv("HF_TOKEN", token)
        assert push(file, "--yes").returncode == 2
    assert set(hub.repositories[KEY].files()) == {".gitattributes"}


def test_offline_unreachable_and_failing_hubs(
    hub: HubServer, model: StoredRepository, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hub.faults["POST */commit/main"] = lambda _: JSONResponse({"error": "out of order"}, 500)
    finished = push(file, "--yes")
    assert finished.returncode == 1
    assert "out of order" in finished.stderr
    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    assert push(file).returncode == 1
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    finished = push(file)
    assert finished.returncode == 2
    assert "HF_HUB_OFFLINE" in finished.stderr
