"""Archive storage in a folder: durable moves, ages, orphans, and a folder that is away."""

from __future__ import annotations

import os
import shutil
import stat
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx2
import pytest

from leaderboard.storage.archive_store import ArchiveNotFoundError, ArchiveStore
from leaderboard.storage.retention import ORPHAN_AGE_S
from leaderboard.uploads.accept import UNAVAILABLE_MESSAGE
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.base.writing import atomic_replace
from tests.leaderboard.serving import RunServer, make_token, running_scorer
from tests.processes import wait_until

CONTENT = bytes(range(256)) * 1000


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder that does not exist yet, two folders deep."""
    return tmp_path / "some where" / "kept"


@pytest.fixture
def new_file(tmp_path: Path) -> Callable[[], Path]:
    def make() -> Path:
        path = tmp_path / f"{time.monotonic_ns()}.upload"
        path.write_bytes(CONTENT)
        return path

    return make


def test_archive_is_stored_listed_read_and_deleted(folder: Path, new_file: Callable[[], Path]) -> None:
    archives = ArchiveStore(folder)
    assert archives.ids() == set()
    source = new_file()
    archives.put("an-id_1", source)
    assert not source.exists(), "an upload that is kept is no longer in the spool"
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == {"an-id_1.zip": CONTENT}
    assert archives.ids() == ArchiveStore(folder).ids() == {"an-id_1"}
    assert archives.path("an-id_1").read_bytes() == CONTENT
    archives.delete("an-id_1")
    assert not list(folder.iterdir())
    assert archives.ids() == set()


def test_missing_archive_raises_on_read_but_not_on_delete(folder: Path) -> None:
    archives = ArchiveStore(folder)
    archives.delete("never-was")
    with pytest.raises(ArchiveNotFoundError):
        archives.path("never-was")
    folder.rmdir()
    with pytest.raises(OSError, match="the folder does not exist"):
        archives.path("never-was")


def test_unusable_folder_is_an_input_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match=r"the archive storage .* cannot be written"):
        ArchiveStore(tmp_path / "file" / "kept")


def test_age_is_that_of_file(folder: Path, new_file: Callable[[], Path]) -> None:
    archives, now = ArchiveStore(folder), time.time()
    archives.put("old", new_file())
    assert archives.age_s("old") == pytest.approx(0, abs=60)
    os.utime(folder / "old.zip", (now - 5000, now - 5000))
    assert archives.age_s("old") == pytest.approx(5000, abs=60)
    assert archives.age_s("deleted meanwhile") == 0


def test_killed_copy_from_another_device_leaves_no_archive(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    archives = ArchiveStore(folder)
    with tempfile.TemporaryDirectory(dir="/dev/shm") as device:
        source = Path(device) / "one.upload"
        source.write_bytes(CONTENT)
        assert source.stat().st_dev != folder.stat().st_dev

        def copy_half(_: Path, target: Path) -> None:
            target.write_bytes(CONTENT[:1000])
            assert archives.ids() == set()
            raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(shutil, "copyfile", copy_half)
            with pytest.raises(KeyboardInterrupt):
                archives.put("an-id", source)
        assert source.read_bytes() == CONTENT
        archives.put("an-id", source)
        assert not source.exists()
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == {"an-id.zip": CONTENT}
    assert stat.S_IMODE(archives.path("an-id").stat().st_mode) == 0o600


def test_leftovers_of_killed_copies_are_deleted_when_they_are_old(folder: Path) -> None:
    archives, now = ArchiveStore(folder), time.time()
    with atomic_replace(folder / "an-id.zip") as temporary:
        temporary.write_bytes(CONTENT)
        for name in (temporary.name, "kept.zip"):
            (folder / name).write_bytes(CONTENT)
            os.utime(folder / name, (now - 5000, now - 5000))
        archives.delete_leftovers(5100)
        assert temporary.exists()
        archives.delete_leftovers(3600)
        assert [path.name for path in folder.iterdir()] == ["kept.zip"]
        temporary.write_bytes(CONTENT)


def test_other_files_are_not_listed(folder: Path) -> None:
    archives = ArchiveStore(folder)
    (folder / "notes.txt").write_text("not ours")
    (folder / "half.part").write_text("under way")
    assert archives.ids() == set()


def test_concurrent_uploads_are_all_stored(folder: Path, new_file: Callable[[], Path]) -> None:
    archives = ArchiveStore(folder)
    names = [f"id-{number}" for number in range(12)]
    with ThreadPoolExecutor(6) as threads:
        list(threads.map(archives.put, names, [new_file() for _ in names]))
    assert archives.ids() == set(names)
    assert {path.read_bytes() for path in folder.iterdir()} == {CONTENT}


def test_service_uses_another_folder(
    tmp_path: Path, small_archive: Path, folder: Path, running_server: RunServer
) -> None:
    state = tmp_path / "state"
    token = make_token(state, "alice")
    with running_server(state, workers=0, archives=folder) as server:
        submission = server.submit_accepted(small_archive, token)
    for name, age_s in (("orphan", 2 * ORPHAN_AGE_S), ("young", 0.0)):
        (folder / f"{name}.zip").write_bytes(CONTENT)
        os.utime(folder / f"{name}.zip", (time.time() - age_s,) * 2)
    with running_server(state, archives=folder) as server:
        assert {path.name for path in folder.iterdir()} == {"orphan.zip", "young.zip", f"{submission}.zip"}
        for name in ("orphan", "young"):
            (folder / f"{name}.zip").unlink()
        assert (folder / f"{submission}.zip").read_bytes() == small_archive.read_bytes()
        assert server.wait_until_ended(submission)["status"] == "scored"
        address, owner = f"{server.url}/api/v1/submissions/{submission}", {"Authorization": f"Bearer {token}"}
        assert httpx2.delete(address, headers=owner, timeout=60).status_code == 204
        assert not list(folder.iterdir())
        assert not (state / "archives").exists()
        wait_until(lambda: not list((state / "spool").iterdir()), "the spool is empty")


def test_storage_outage_keeps_quota_and_requeues_job(
    tmp_path: Path, small_archive: Path, running_server: RunServer
) -> None:
    state, archives = tmp_path / "state", tmp_path / "state" / "archives"
    with running_server(state, quota=1, workers=0) as server:
        token = server.token("alice")
        archives.rename(tmp_path / "away")
        response = server.submit(small_archive, token)
        assert (response.status_code, response.json()["detail"]) == (503, UNAVAILABLE_MESSAGE)
        (tmp_path / "away").rename(archives)
        submission = server.submit_accepted(small_archive, token)
        assert not list((state / "spool").iterdir())
        with running_scorer(state) as log:
            wait_until(lambda: any("waiting for submissions" in line for line in log), "the scorer has started")
            assert server.wait_until_ended(submission)["status"] == "scored"
