"""Publishing of dataset folders on a Hub on this machine."""

from __future__ import annotations

import hashlib
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from huggingface_hub import constants
from starlette.requests import Request

from dataset_builder.cli.main import main
from tests.builder.push.conftest import (
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
from tests.commands import run_in_process
from tests.hub_server import GITATTRIBUTES, LFS_SUFFIXES, HubServer, folder_files, running_hub
from tests.synthetic_dataset import write_dataset

READ_BACK = """
import sys
import datasets
import dataset_builder.cli.main
import rebar_depth_bench as rdb
from rebar_depth_bench.cli.main import main
local, published = (rdb.load(root, "lattice") for root in sys.argv[1:])
for one, other in zip(local, published, strict=True):
    assert one["view_id"] == other["view_id"]
    for name in ("left_rgb", "right_depth", "left_bars", "left_K", "right_cam_from_world"):
        assert one[name].tobytes() == other[name].tobytes(), name
for table in ("bars", "crossings"):
    local, published = (datasets.load_dataset(root, table, split="train") for root in sys.argv[1:])
    assert len(local) > 0
    assert published.to_list() == local.to_list()
assert main(["verify", sys.argv[2]]) == 0
sys.exit(dataset_builder.cli.main.main(["croissant", f"{sys.argv[2]}@main"]))
"""


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
    verified, description = read.stdout.split("{", 1)
    assert "no problem found in 10 files, 11 views" in verified
    named = run_in_process(main, "croissant", tiny_root, "--hub-id", HUB_ID)
    assert "{" + description == named.stdout


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


def test_croissant_description_of_the_repository_is_kept(hub: HubServer, root: Path) -> None:
    hub.add(KEY, {"manifest.json": b"{}", "croissant.json": b"mine", "notes.txt": b""})
    (root / "croissant.json").write_text("not sent")
    finished = push(root, "--yes")
    assert finished.returncode == 0, finished.stderr
    (root / "croissant.json").write_text("mine")
    assert visible(hub.repositories[KEY]) == folder_files(root)


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


def test_stray_files_stay_local_and_a_gitignore_leaves_nothing_out(hub: HubServer, root: Path) -> None:
    listed = folder_files(root)
    hub.add(KEY, {".gitignore": b"*.parquet\nmanifest.json\n"})
    for name in ("notes.txt", "lattice/old.parquet", ".rebar-build/lock"):
        (root / name).parent.mkdir(exist_ok=True)
        (root / name).write_text("mine")
    finished = push(root, "--yes")
    assert finished.returncode == 0
    assert "notes.txt" in finished.stderr
    assert visible(hub.repositories[KEY]) == listed


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


@pytest.mark.parametrize("header", ["", "---\nconfigs: [\n---\n", "---\n- 1\n---\n", "\xff"])
def test_card_that_nobody_could_read_is_refused(hub: HubServer, root: Path, header: str) -> None:
    (root / "README.md").write_text(header, encoding="latin-1")
    refused(list_files(root), "--yes", words="README.md")
    assert hub.repositories == {}


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
