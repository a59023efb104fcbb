"""Storage of archives, and kills at every change of backup, prune, retention and rescoring: nothing is lost."""

from __future__ import annotations

import os
import shutil
import signal
import sqlite3
import stat
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import pytest

from leaderboard.db import jobs, submissions
from leaderboard.settings import Settings
from leaderboard.storage.archive_store import ArchiveNotFoundError, ArchiveStore
from leaderboard.storage.backup import back_up
from leaderboard.storage.retention import ORPHAN_AGE_S, prune_archives
from leaderboard.uploads.accept import UNAVAILABLE_MESSAGE
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.base.writing import atomic_replace
from tests.leaderboard.boards import (
    DIGEST,
    OTHER_DIGEST,
    add_submission,
    assert_sound,
    board_settings,
    facts,
    killed,
    make_board,
    opened,
    score_all,
)
from tests.leaderboard.serving import API, RunScorer, RunServer
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


def test_service_uses_another_folder(small_archive: Path, folder: Path, running_server: RunServer) -> None:
    with running_server(workers=0, archives=folder) as server:
        token = server.token("alice")
        submission = server.submit_accepted(small_archive, token)
    for name, age_s in (("orphan", 2 * ORPHAN_AGE_S), ("young", 0.0)):
        (folder / f"{name}.zip").write_bytes(CONTENT)
        os.utime(folder / f"{name}.zip", (time.time() - age_s,) * 2)
    with running_server(server.state, archives=folder) as server:
        assert {path.name for path in folder.iterdir()} == {"orphan.zip", "young.zip", f"{submission}.zip"}
        for name in ("orphan", "young"):
            (folder / f"{name}.zip").unlink()
        assert (folder / f"{submission}.zip").read_bytes() == small_archive.read_bytes()
        assert server.wait_until_ended(submission)["status"] == "scored"
        assert server.call("DELETE", f"{API}/{submission}", token).status_code == 204
        assert not list(folder.iterdir())
        assert not (server.state / "archives").exists()
        wait_until(lambda: not server.spool_files(), "the spool is empty")


def test_storage_outage_keeps_quota_and_requeues_job(
    tmp_path: Path, small_archive: Path, running_server: RunServer, running_scorer: RunScorer
) -> None:
    with running_server(quota=1, workers=0) as server:
        token, archives = server.token("alice"), server.state / "archives"
        archives.rename(tmp_path / "away")
        response = server.submit(small_archive, token)
        assert (response.status_code, response.json()["detail"]) == (503, UNAVAILABLE_MESSAGE)
        (tmp_path / "away").rename(archives)
        submission = server.submit_accepted(small_archive, token)
        assert server.spool_files() == []
        with running_scorer(server.state) as log:
            wait_until(lambda: any("waiting for submissions" in line for line in log), "the scorer has started")
            assert server.wait_until_ended(submission)["status"] == "scored"


MAX_OPERATIONS = 200


def kill_everywhere(
    operation: Callable[..., object], check: Callable[..., object], prepare: Callable[[], tuple[object, ...]]
) -> None:
    """Kill an operation before its first, second, ... change until it ends; check its arguments each time."""
    for kill_at in range(1, MAX_OPERATIONS):
        arguments = prepare()
        was_killed = killed(kill_at, operation, *arguments)
        check(*arguments)
        if not was_killed:
            assert kill_at > 3, "the operation changes nothing"
            return
    raise AssertionError(f"more than {MAX_OPERATIONS} operations")


def change_and_die(settings: Settings, submission_id: str) -> None:
    """Change a row of a backup, as a server that is killed does: the change is in the write-ahead log only."""
    with opened(settings) as (database, _):
        submissions.change(database, submission_id, {"reason": "changed in the backup"})
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.slow
@pytest.mark.parametrize("prune", [False, True])
def test_killed_backup_is_whole_and_can_be_repeated(tmp_path: Path, prune: bool) -> None:
    settings, target = board_settings(tmp_path / "state"), tmp_path / "backup"
    token = make_board(settings)
    removed, pruned, kept = (add_submission(settings, token, content) for content in (b"1", b"2", b"3"))
    back_up(settings, target, prune=False)
    assert killed(MAX_OPERATIONS, change_and_die, board_settings(target), kept)
    assert (target / "leaderboard.sqlite-wal").stat().st_size > 0
    with opened(settings) as (database, archives):
        submissions.remove(database, removed)
        prune_archives(database, archives, [pruned])
    new = [add_submission(settings, token, content, scored=False) for content in (b"4", b"5")]
    shutil.copytree(target, tmp_path / "earlier")
    earlier = {removed, pruned, kept}

    def prepare() -> tuple[object, ...]:
        shutil.rmtree(target)
        shutil.copytree(tmp_path / "earlier", target)
        return settings, target, prune

    def check(*arguments: object) -> None:
        backup = board_settings(target)
        found = set(facts(backup))
        assert found in (earlier, earlier | set(new))
        assert_sound(backup)
        back_up(settings, target, prune)
        assert_sound(backup)
        shown = facts(settings)
        if not prune:
            shown |= {name: (*shown[name][:3], True) for name in (removed, pruned)}
        assert facts(backup) == shown
        others = [path.name for path in target.rglob("*") if path.name.startswith(".") or "wal" in path.name]
        assert others == []
        if found == earlier:
            with closing(sqlite3.connect(target / "leaderboard.sqlite.1")) as former:
                query = "SELECT reason FROM submissions WHERE id = ?"
                assert former.execute(query, (kept,)).fetchone() == ("changed in the backup",)

    kill_everywhere(back_up, check, prepare)


@pytest.mark.slow
def test_killed_first_backup_can_be_repeated(tmp_path: Path) -> None:
    settings, target = board_settings(tmp_path / "state"), tmp_path / "backup"
    add_submission(settings, make_board(settings), b"1")

    def prepare() -> tuple[object, ...]:
        shutil.rmtree(target, ignore_errors=True)
        return settings, target, False

    def check(*_: object) -> None:
        if (target / "leaderboard.sqlite").exists():
            assert_sound(board_settings(target))
        back_up(settings, target, prune=False)
        assert facts(board_settings(target)) == facts(settings)

    kill_everywhere(back_up, check, prepare)


def prune(settings: Settings, submission_ids: list[str]) -> None:
    with opened(settings) as (database, archives):
        prune_archives(database, archives, submission_ids)


def remove(settings: Settings, submission_id: str) -> None:
    with opened(settings) as (database, archives):
        submissions.remove(database, submission_id)
        prune_archives(database, archives, [])


@pytest.mark.slow
@pytest.mark.parametrize("operation", [prune, remove])
def test_killed_deletion_is_finished_by_the_next_start(
    tmp_path: Path, new_database: Callable[[], str], operation: Callable[..., object]
) -> None:
    boards = iter(range(MAX_OPERATIONS))
    expected: dict[str, set[str]] = {}

    def prepare() -> tuple[object, ...]:
        settings = board_settings(tmp_path / f"state-{next(boards)}", db=new_database())
        token = make_board(settings)
        ids = [add_submission(settings, token, content) for content in (b"1", b"2", b"3")]
        expected["kept"] = {ids[2]}
        expected["gone"] = set(ids[:2]) if operation is prune else {ids[0]}
        expected["kept"] |= set(ids) - expected["gone"]
        return settings, ids[:2] if operation is prune else ids[0]

    def check(settings: Settings, _: object) -> None:
        def stored() -> set[str]:
            return {name for name, (*_, has_archive) in facts(settings).items() if has_archive}

        assert expected["kept"] <= stored()
        with opened(settings) as (database, archives):
            marked = {name for name, row in submissions.archive_rows(database).items() if row is None}
            assert stored() >= set(facts(settings)) - marked, "an archive is deleted before its row says so"
            prune_archives(database, archives, [])  # As at a start.
            assert stored() == set(facts(settings)) - marked
        assert_sound(settings)
        operation(settings, list(expected["gone"]) if operation is prune else min(expected["gone"]))
        assert stored() == expected["kept"]

    kill_everywhere(operation, check, prepare)


def rescore(settings: Settings) -> None:
    with opened(settings) as (database, archives):
        jobs.requeue_stale(database, OTHER_DIGEST, archives.ids(), rescore=True)
        score_all(database)


@pytest.mark.slow
def test_killed_rescoring_keeps_every_result(tmp_path: Path, new_database: Callable[[], str]) -> None:
    boards = iter(range(MAX_OPERATIONS))
    ids: list[str] = []

    def prepare() -> tuple[object, ...]:
        settings = board_settings(tmp_path / f"state-{next(boards)}", db=new_database())
        token = make_board(settings)
        ids[:] = [add_submission(settings, token, content) for content in (b"1", b"2", b"3", b"4")]
        prune(settings, ids[:1])
        (settings.archive_dir / f"{ids[0]}.zip").write_bytes(b"1")  # As a crash leaves it.
        (settings.archive_dir / f"{ids[1]}.zip").unlink()
        return (settings,)

    def check(settings: Settings) -> None:
        pruned, lost = (("scored", DIGEST, DIGEST, has_archive) for has_archive in (True, False))
        for name, (status, dataset, of_result, has_archive) in facts(settings).items():
            if name in ids[:2]:
                assert (status, dataset, of_result, has_archive) == (pruned if has_archive else lost)
            else:
                assert has_archive
                assert of_result in (DIGEST, OTHER_DIGEST)
                assert status in ("queued", "scoring") or dataset == of_result
        rescore(settings)
        new = ("scored", OTHER_DIGEST, OTHER_DIGEST, True)
        assert facts(settings) == dict(zip(ids, (pruned, lost, new, new), strict=True))

    kill_everywhere(rescore, check, prepare)


def test_archive_that_cannot_be_deleted_delays_no_other(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = board_settings(tmp_path / "state")
    token = make_board(settings)
    ids = sorted(add_submission(settings, token, content) for content in (b"1", b"2", b"3"))
    delete = ArchiveStore.delete

    def fail_first(archives: ArchiveStore, submission_id: str) -> None:
        if submission_id == ids[0]:
            raise PermissionError(13, "Permission denied")
        delete(archives, submission_id)

    with monkeypatch.context() as patch:
        patch.setattr(ArchiveStore, "delete", fail_first)
        prune(settings, ids)
    assert [name for name, fact in facts(settings).items() if fact[3]] == ids[:1]
    assert "archive not deleted" in "".join(capsys.readouterr())
    prune(settings, [])
    assert not any(fact[3] for fact in facts(settings).values())
