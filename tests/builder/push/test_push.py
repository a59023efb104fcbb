"""Publishing of dataset folders on a Hub on this machine, also one that refuses, fails or is hostile."""

from __future__ import annotations

import hashlib
import json
import signal
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from huggingface_hub import constants
from starlette.requests import Request
from starlette.responses import JSONResponse, RedirectResponse, Response

from tests.builder.push.published import (
    HUB_ID,
    KEY,
    accept_xet,
    environment,
    list_files,
    push,
    refused,
    visible,
    write_publishable,
)
from tests.hub_server import GITATTRIBUTES, LFS_SUFFIXES, READ_TOKEN, TOKEN, HubServer, folder_files, running_hub
from tests.synthetic_dataset import write_dataset

READ_BACK = """
import sys
import rebar_depth_bench as rdb
from rebar_depth_bench.cli.main import main
local, published = (rdb.load(root, "lattice") for root in sys.argv[1:])
for one, other in zip(local, published, strict=True):
    assert one["view_id"] == other["view_id"]
    for name in ("left_rgb", "right_depth", "left_bars", "left_K", "right_cam_from_world"):
        assert one[name].tobytes() == other[name].tobytes(), name
sys.exit(main(["verify", sys.argv[2]]))
"""


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_publishable(tmp_path / "dataset")


def test_dry_run_lists_the_files_without_a_network(
    hub: HubServer, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    finished = push(root, "--dry-run")
    assert finished.returncode == 0, finished.stderr
    sizes = {name: len(content) for name, content in folder_files(root).items()}
    head, *files, totals, end = finished.stdout.splitlines()
    assert head == f"{HUB_ID}, branch main"
    assert files == [f"  {name}, {size:,} bytes" for name, size in sorted(sizes.items())]
    assert totals.startswith(f"{len(sizes)} files ({sum(sizes.values()):,} bytes); ")
    assert end == "dry run: not compared with the Hub, nothing was sent"
    assert hub.requests == []
    assert push(root, "--dry-run", "--private").stdout.startswith(f"{HUB_ID}, branch main, private\n")
    assert push(root, "--dry-run", "--yes").returncode == 2


def test_without_yes_the_files_are_listed_and_nothing_is_written(hub: HubServer, root: Path) -> None:
    finished = push(root)
    assert finished.returncode == 0
    for name, content in folder_files(root).items():
        assert f"new      {name}, {len(content):,} bytes\n" in finished.stdout
    assert "will be created" in finished.stdout
    assert "--yes" in finished.stdout
    assert hub.written() == []
    assert hub.repositories == {}


@pytest.mark.slow
def test_published_folder_is_read_back_byte_for_byte(tiny_root: Path, hub: HubServer, tmp_path: Path) -> None:
    finished = push(tiny_root, "--yes")
    assert finished.returncode == 0, finished.stderr
    repository = hub.repositories[KEY]
    assert visible(repository) == folder_files(tiny_root)
    assert finished.stdout.splitlines()[-1] == f"{hub.url}/{KEY}/commit/{repository.branches['main']}"
    command = [sys.executable, "-c", READ_BACK, str(tiny_root), HUB_ID]
    reading = environment(hub, tmp_path, HF_TOKEN="")
    read = subprocess.run(command, env=reading, capture_output=True, text=True, timeout=300, check=False)
    assert read.returncode == 0, read.stderr
    assert "no problem found in 10 files, 11 views" in read.stdout


def test_one_commit_makes_everything_visible_and_a_second_push_makes_none(hub: HubServer, root: Path) -> None:
    assert push(root, "--yes").returncode == 0
    assert len(hub.repositories[KEY].commits) == 2  # the Hub's own, and ours
    assert hub.written()[-1] == f"POST /api/{KEY}/commit/main"
    hub.requests.clear()
    for options in (["--yes"], []):
        finished = push(root, *options)
        assert finished.returncode == 0
        assert "up to date" in finished.stdout
    assert hub.written() == []


def test_only_changes_are_sent_and_files_of_an_earlier_version_are_deleted(
    hub: HubServer, root: Path, tmp_path: Path
) -> None:
    assert push(root, "--yes").returncode == 0
    hub.requests.clear()
    later = write_publishable(tmp_path / "later", ["lattice"])
    planned = push(later).stdout
    assert "deleted  pile/test.parquet\n" in planned
    assert "changed  manifest.json" in planned
    assert "lattice/test.parquet" not in planned
    assert push(later, "--yes").returncode == 0
    assert visible(hub.repositories[KEY]) == folder_files(later)
    assert hub.repositories[KEY].files()[".gitattributes"] == GITATTRIBUTES
    assert hub.uploads() == []  # Only small files changed, which are part of the commit.


def test_killed_push_continues_without_sending_again_what_arrived(root: Path, tmp_path: Path) -> None:
    with running_hub() as hub:
        command = [sys.executable, "-m", "dataset_builder", "push", str(root), "--hub-id", HUB_ID, "--yes"]
        processes = list[subprocess.Popen[bytes]]()

        def kill_at_the_third_upload(_: Request) -> None:
            if len(hub.uploads()) >= 3:  # Several may arrive at the same time.
                processes[0].send_signal(signal.SIGKILL)

        hub.faults["PUT *"] = kill_at_the_third_upload
        log = tmp_path / "log"
        with log.open("wb") as output:
            processes.append(
                subprocess.Popen(command, env=environment(hub, tmp_path), stdout=output, stderr=output)
            )
        assert processes[0].wait(timeout=120) == -signal.SIGKILL
        hub.faults.clear()
        arrived = set(hub.objects)
        assert arrived
        assert visible(hub.repositories[KEY]) == {}
        hub.requests.clear()
        with log.open("ab") as output:
            finished = subprocess.run(
                command, env=environment(hub, tmp_path), stdout=output, stderr=output, timeout=120
            )
        assert finished.returncode == 0, log.read_text()
        assert not arrived & set(hub.uploads())
        assert visible(hub.repositories[KEY]) == folder_files(root)


def test_stray_files_stay_local(hub: HubServer, root: Path) -> None:
    listed = folder_files(root)
    for name in ("notes.txt", "lattice/old.parquet", ".rebar-build/lock"):
        (root / name).parent.mkdir(exist_ok=True)
        (root / name).write_text("mine")
    finished = push(root, "--yes")
    assert finished.returncode == 0
    assert "notes.txt" in finished.stderr
    assert visible(hub.repositories[KEY]) == listed


def test_gitignore_of_the_repository_leaves_nothing_out(hub: HubServer, root: Path) -> None:
    repository = hub.add(KEY, {".gitignore": b"*.parquet\nmanifest.json\n"})
    assert push(root, "--yes").returncode == 0
    assert visible(repository) == folder_files(root)


def test_private_repository_and_branch_are_created(hub: HubServer, root: Path) -> None:
    assert push(root, "--yes", "--private", "--revision", "v1").returncode == 0
    repository = hub.repositories[KEY]
    assert repository.private
    assert visible(repository) == {}
    assert visible(repository, "v1") == folder_files(root)
    assert push(root, "--yes", "--private", "--revision", "v1").stdout.endswith("nothing to send\n")


def test_branch_of_a_published_version_needs_no_upload(hub: HubServer, root: Path) -> None:
    assert push(root, "--yes").returncode == 0
    hub.requests.clear()
    assert "will be created" in push(root, "--revision", "v1").stdout
    assert push(root, "--yes", "--revision", "v1").returncode == 0
    repository = hub.repositories[KEY]
    assert repository.branches["v1"] == repository.branches["main"]
    assert hub.uploads() == []


def test_folder_that_does_not_match_its_manifest_is_refused_before_any_request(
    hub: HubServer, root: Path, tmp_path: Path
) -> None:
    shard = root / "lattice" / "test.parquet"
    content = shard.read_bytes()
    for damage in (lambda: shard.write_bytes(content[:-1] + b"x"), shard.unlink):
        damage()
        for options in ([], ["--yes"]):
            refused(root, *options, words="lattice/test.parquet")
    (unfinished := tmp_path / "unfinished").mkdir()
    write_dataset(listed_partly := tmp_path / "partly", ["lattice"], 1)
    for folder in (unfinished, listed_partly, tmp_path / "nowhere", Path(HUB_ID)):
        assert push(folder, "--yes").returncode == 2
    assert hub.requests == []


@pytest.mark.parametrize(
    "header",
    [
        "",
        "---\nconfigs: [\n---\n",
        "---\nlicense: mit\n---\n",
        "---\nconfigs:\n- config_name: pier\n---\n",
        "\xff",
    ],
)
def test_card_that_the_parser_of_the_hub_does_not_read_is_refused(hub: HubServer, root: Path, header: str) -> None:
    (root / "README.md").write_text(header, encoding="latin-1")
    refused(list_files(root), "--yes", words="README.md")
    assert hub.requests == []


@pytest.mark.slow
def test_xet_stores_the_content_under_the_digests_of_the_manifest(
    hub: HubServer, root: Path, tmp_path: Path
) -> None:
    committed = accept_xet(hub, tmp_path / "store")
    command = [sys.executable, "-m", "dataset_builder", "push", str(root), "--hub-id", HUB_ID, "--yes"]
    settings = environment(hub, tmp_path, HF_HUB_DISABLE_XET="0")
    finished = subprocess.run(command, env=settings, capture_output=True, text=True, timeout=120, check=False)
    assert finished.returncode == 0, finished.stderr
    assert hub.uploads() == []
    large = {name: file for name, file in folder_files(root).items() if name.endswith(LFS_SUFFIXES)}
    assert committed == {name: hashlib.sha256(file).hexdigest() for name, file in large.items()}
    stored_bytes = sum(path.stat().st_size for path in (tmp_path / "store").rglob("*") if path.is_file())
    assert stored_bytes > max(map(len, large.values()))


READING = ["GET */revision/main", "GET */tree/*"]
WRITING = [
    "POST /api/validate-yaml",
    "POST /api/repos/create",
    "POST */preupload/main",
    "POST */objects/batch",
    "POST */commit/main",
]


def test_commands_that_need_no_request_are_refused_without_one(hub: HubServer, root: Path) -> None:
    for hub_id in ("", "data", "a/b/c", "org/data@v1", "-org/x", "../data", "org/a--b"):
        refused(root, "--yes", hub_id=hub_id, words="--hub-id")
    for revision in ("", "../x", "a b", "-x", "\x1b[2J"):
        assert "\x1b" not in refused(root, "--yes", f"--revision={revision}", words="--revision")
    assert hub.requests == []


def test_missing_token_and_offline_mode_are_refused(
    hub: HubServer, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as without_token:
        without_token.delenv("HF_TOKEN")
        assert push(root).returncode == 0
        hub.requests.clear()
        no_token = push(root, "--yes")
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    for finished, name in ((no_token, "HF_TOKEN"), (push(root, "--yes"), "HF_HUB_OFFLINE")):
        assert finished.returncode == 2
        assert name in finished.stderr
    assert hub.requests == []


@pytest.mark.parametrize(("token", "status"), [(f"{TOKEN}x", 401), (READ_TOKEN, 403)])
def test_token_that_the_hub_does_not_accept(
    hub: HubServer, root: Path, monkeypatch: pytest.MonkeyPatch, token: str, status: int
) -> None:
    monkeypatch.setenv("HF_TOKEN", token)
    assert token not in refused(root, "--yes", words=f"status {status}")
    assert hub.repositories == {}


def test_unreachable_hub_is_named_with_status_1(
    root: Path, hub: HubServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    refused(root, words="http://127.0.0.1:9", status=1)


@pytest.mark.parametrize("content", ["<html>", "null", "{}", '[{"type": "file"}]'])
@pytest.mark.parametrize("request_pattern", [*READING, *WRITING])
def test_answers_that_are_not_those_of_a_hub(
    hub: HubServer, root: Path, request_pattern: str, content: str
) -> None:
    hub.add(KEY)
    if request_pattern == "POST /api/repos/create":
        del hub.repositories[KEY]
    hub.faults[request_pattern] = lambda _: Response(content, media_type="application/json")
    finished = push(root, "--yes")
    may_succeed = request_pattern == "POST /api/validate-yaml" or (request_pattern, content) == (READING[1], "{}")
    if finished.returncode == 0:
        assert may_succeed
    else:
        assert finished.returncode in (1, 2)
        assert "error: " in finished.stderr
        assert all(set(one.files()) <= {".gitattributes"} for one in hub.repositories.values())


@pytest.mark.parametrize("status", [400, 409, 500, 507])
@pytest.mark.parametrize("request_pattern", [READING[0], "POST /api/repos/create", "POST */commit/main"])
def test_refusal_of_the_hub_is_reported_with_its_status(
    hub: HubServer, root: Path, request_pattern: str, status: int
) -> None:
    message = "Storage quota of org is used up \x1b[2J"
    answer = JSONResponse({"error": f"{message} {TOKEN}"}, status)
    hub.faults[request_pattern] = lambda _: answer
    finished = push(root, "--yes")
    if request_pattern == "POST /api/repos/create" and status == 409:
        # The repository exists, says the Hub, without the address that it then gives.
        assert finished.returncode == 1
        return
    assert finished.returncode == (2 if status == 400 else 1)
    assert f"status {status} " in finished.stderr
    assert "Storage quota of org" in finished.stderr
    assert "\x1b" not in finished.stderr


def redirect(url: str, status: int, request: Request) -> Response:
    return RedirectResponse(f"{url}{request.scope['path']}", status)


@pytest.mark.parametrize("request_pattern", [*READING, "POST /api/repos/create", "POST */commit/main"])
def test_redirects_to_another_server_do_not_take_the_token_along(
    hub: HubServer, root: Path, request_pattern: str
) -> None:
    with running_hub() as elsewhere:
        elsewhere.faults["*"] = lambda _: JSONResponse({"error": "mine"})
        for status in (302, 307):
            hub.faults[request_pattern] = partial(redirect, elsewhere.url, status)
            finished = push(root, "--yes")
            assert finished.returncode in (1, 2)
            assert "error: " in finished.stderr
        assert elsewhere.requests
        assert all(one.authorization == "" for one in elsewhere.requests)


def test_card_that_the_hub_refuses(hub: HubServer, root: Path) -> None:
    card = root / "README.md"
    card.write_text(card.read_text().replace("license: cc-by-4.0\n", ""))
    refused(list_files(root), "--yes", words='"license" is required')
    assert hub.repositories == {}


def test_public_repository_and_one_with_other_content_are_refused(hub: HubServer, root: Path) -> None:
    hub.add(KEY)
    refused(root, "--yes", "--private", words="public")
    files = {"model.safetensors": b"weights", "README.md": b"mine"}
    repository = hub.add(KEY, files)
    for options in ([], ["--yes"]):
        refused(root, *options, words="manifest.json")
    assert hub.written() == []
    del repository.commits[repository.branches["main"]]
    repository.commit("main", {"README.md": b"made by the web page"})
    assert push(root, "--yes").returncode == 0


def test_commit_of_someone_else_in_between_is_not_overwritten(hub: HubServer, root: Path) -> None:
    repository = hub.add(KEY)
    theirs = {"manifest.json": b"theirs"}

    def commit_theirs(_: Request) -> None:
        if repository.files() != theirs:
            repository.commit("main", theirs)

    hub.faults["PUT *"] = commit_theirs
    refused(root, "--yes", words="status 412", status=1)
    assert repository.files() == theirs


def rewrite(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1] + b"x")


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("manifest.json", rewrite, "manifest.json"),
        ("README.md", rewrite, "README.md"),
        ("lattice/test.parquet", rewrite, "lattice/test.parquet"),
        ("lattice/test.parquet", Path.unlink, "test.parquet cannot be read"),
    ],
)
def test_file_that_changes_during_the_upload_is_not_published(
    hub: HubServer, root: Path, name: str, change: Callable[[Path], None], words: str
) -> None:
    hub.faults["POST */preupload/main"] = lambda _: change(root / name)
    refused(root, "--yes", words=words)
    assert set(hub.repositories[KEY].files()) == {".gitattributes"}


def test_upload_whose_content_the_hub_finds_damaged(hub: HubServer, root: Path) -> None:
    hub.faults["PUT *"] = lambda _: JSONResponse({"error": "checksum mismatch"}, 400)
    refused(root, "--yes", words="checksum mismatch")
    assert set(hub.repositories[KEY].files()) == {".gitattributes"}


def test_names_of_files_on_the_hub_are_shown_without_control_characters(hub: HubServer, root: Path) -> None:
    hub.add(KEY, {"manifest.json": b"{}", "a\x1b[2J": b""})
    finished = push(root)
    assert finished.returncode == 0
    assert "deleted  a" in finished.stdout
    assert "\x1b" not in finished.stdout


def test_warnings_of_the_hub_are_shown_as_plain_text(hub: HubServer, root: Path) -> None:
    warning = json.dumps({"errors": [], "warnings": [{"message": f"empty metadata\x1b[2J {TOKEN}"}]})
    hub.faults["POST /api/validate-yaml"] = lambda _: Response(warning)
    finished = push(root, "--yes")
    assert finished.returncode == 0
    assert "empty metadata" in finished.stderr
    assert "\x1b" not in finished.stderr
    assert folder_files(root).items() <= hub.repositories[KEY].files().items()
