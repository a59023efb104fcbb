"""Storage of archives, and kills at every change of backup, deletion and rescoring: nothing is lost."""

from __future__ import annotations

import os
import shutil
import signal
import sqlite3
import stat
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from leaderboard.db import jobs, submissions
from leaderboard.settings import Settings
from leaderboard.storage.archive_store import MARKER, ArchiveStore
from leaderboard.storage.backup import back_up
from leaderboard.uploads import UNAVAILABLE_MESSAGE
from rebar_depth_bench.base.errors import StorageError
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
from tests.leaderboard.serving import API, RunServer, distinct_archive, run
from tests.processes import wait_until

CONTENT = bytes(range(256)) * 1000


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder that does not exist yet, two folders deep."""
    return tmp_path / "some where" / "kept"


@pytest.fixture
def archives(folder: Path) -> ArchiveStore:
    """Return a new archive folder, of the database with the id ``ab``."""
    store = ArchiveStore(folder, "ab")
    store.initialise({})
    return store


def stored(folder: Path) -> dict[str, bytes]:
    """Return the content of all files but the marker by name."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.name != MARKER}


@pytest.mark.parametrize("wrong", ["missing", "empty", "other database"])
def test_wrong_folder_is_refused_by_every_operation(
    folder: Path, archives: ArchiveStore, tmp_path: Path, wrong: str
) -> None:
    source = tmp_path / "one.upload"
    source.write_bytes(CONTENT)
    shutil.rmtree(folder)
    if wrong != "missing":
        folder.mkdir()
    if wrong == "other database":
        ArchiveStore(folder, "cd").initialise({})
    archives.initialise({"an-id": ("0" * 64, 1)})
    for use in (archives.ids, archives.check, lambda: archives.path("an-id"), lambda: archives.delete("an-id")):
        with pytest.raises(StorageError, match=f"{folder}: (has no file|belongs to the database with the id cd)"):
            use()
    with pytest.raises(StorageError):
        archives.put("new", source)
    assert not folder.exists() or stored(folder) == {}
    archives.initialise({"an-id": None})  # No row needs an archive any more.
    if wrong == "other database":
        with pytest.raises(StorageError):
            archives.check()
    else:
        archives.check()


def test_folder_with_archives_gets_no_marker(folder: Path) -> None:
    folder.mkdir(parents=True)
    (folder / "an-id.zip").write_bytes(CONTENT)
    ArchiveStore(folder, "ab").initialise({})
    assert not (folder / MARKER).exists()


def test_killed_copy_from_another_device_leaves_no_archive(
    folder: Path, archives: ArchiveStore, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    assert stored(folder) == {"an-id.zip": CONTENT}
    assert stat.S_IMODE(archives.path("an-id").stat().st_mode) == 0o600


def test_leftovers_of_killed_copies_are_deleted_when_they_are_old(folder: Path, archives: ArchiveStore) -> None:
    now = time.time()
    with atomic_replace(folder / "an-id.zip") as temporary:
        temporary.write_bytes(CONTENT)
        for name in (temporary.name, "kept.zip"):
            (folder / name).write_bytes(CONTENT)
            os.utime(folder / name, (now - 5000, now - 5000))
        archives.finish_deletions({}, copy_age_s=5100)
        assert temporary.exists()
        archives.finish_deletions({})
        assert stored(folder) == {"kept.zip": CONTENT}
        temporary.write_bytes(CONTENT)


def test_service_uses_another_folder(small_archive: Path, folder: Path, running_server: RunServer) -> None:
    with running_server(workers=0, archives=folder) as server:
        token = server.token("alice")
        submission = server.submit_accepted(small_archive, token)
    (folder / "orphan.zip").write_bytes(CONTENT)
    with running_server(server.state, archives=folder) as server:
        assert set(stored(folder)) == {"orphan.zip", f"{submission}.zip"}
        assert (folder / f"{submission}.zip").read_bytes() == small_archive.read_bytes()
        assert server.wait_until_ended(submission)["status"] == "scored"
        assert server.call("DELETE", f"{API}/{submission}", token).status_code == 204
        assert set(stored(folder)) == {"orphan.zip"}
        assert not (server.state / "archives").exists()
        wait_until(lambda: not server.spool_files(), "the spool is empty")


@pytest.mark.parametrize("outage", ["away", "not mounted"])
def test_archive_folder_that_is_not_mounted_loses_nothing(
    tmp_path: Path, small_archive: Path, tiny_root: Path, running_server: RunServer, outage: str
) -> None:
    with running_server(workers=0) as server:
        token, state = server.token("alice"), server.state
        waiting, archives = server.submit_accepted(small_archive, token), state / "archives"
        before = server.get("/api/v1/token", token).json()
    archives.rename(tmp_path / "away")
    if outage == "not mounted":
        archives.mkdir()
    with running_server(state, workers=1) as server:
        for archive in (small_archive, distinct_archive(small_archive, 7)):
            response = server.submit(archive, token)
            assert (response.status_code, response.json()["detail"]) == (503, UNAVAILABLE_MESSAGE)
        assert server.call("DELETE", f"{API}/{waiting}", token).status_code == 503
        assert server.get("/api/v1/token", token).json() == before
        health = server.get("/healthz")
        assert health.status_code == 503
        assert "has no file leaderboard-id" in str(health.json()["problems"])
        options = ("--state-dir", state)
        commands = (("check", "--data", tiny_root), ("backup", tmp_path / "copy"), ("remove", waiting))
        for command in (*commands, ("requeue", waiting)):
            process = run(*command, *options)
            assert process.returncode == 1, command
            assert "has no file leaderboard-id" in process.stderr
        wait_until(lambda: any("job requeued" in line for line in server.log), "the job waits")
        assert server.row(waiting)["attempts"] <= 1
        assert not archives.exists() or list(archives.iterdir()) == []
        if outage == "not mounted":
            archives.rmdir()
        (tmp_path / "away").rename(archives)
        assert server.wait_until_ended(waiting)["status"] == "scored"
        assert server.get("/healthz").status_code == 200
        assert server.submit(distinct_archive(small_archive, 8), token).status_code == 202


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
    removed, freed, kept = (add_submission(settings, token, content) for content in (b"1", b"2", b"3"))
    back_up(settings, target, prune=False)
    assert killed(MAX_OPERATIONS, change_and_die, board_settings(target), kept)
    assert (target / "leaderboard.sqlite-wal").stat().st_size > 0
    remove(settings, removed)
    free_archive(settings, freed)
    new = [add_submission(settings, token, content, scored=False) for content in (b"4", b"5")]
    shutil.copytree(target, tmp_path / "earlier")
    earlier = {removed, freed, kept}

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
            shown |= {name: (*shown[name][:2], True) for name in (removed, freed)}
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


def remove(settings: Settings, submission_id: str) -> None:
    with opened(settings) as (database, archives):
        submissions.remove(database, submission_id)
        archives.delete(submission_id)


def free_archive(settings: Settings, submission_id: str) -> None:
    """Delete an archive and keep its submission, as ``remove --archive-only`` does."""
    with opened(settings) as (database, archives):
        submissions.change(database, submission_id, {"archive_deleted_at": time.time()})
        archives.delete(submission_id)


@pytest.mark.slow
@pytest.mark.parametrize("operation", [free_archive, remove])
def test_killed_deletion_is_finished_by_the_next_start(
    tmp_path: Path, new_database: Callable[[], str], operation: Callable[[Settings, str], object]
) -> None:
    boards = iter(range(MAX_OPERATIONS))
    kept: list[str] = []

    def prepare() -> tuple[object, ...]:
        settings = board_settings(tmp_path / f"state-{next(boards)}", db=new_database())
        token = make_board(settings)
        gone, kept[:] = add_submission(settings, token, b"1"), [add_submission(settings, token, b"2")]
        return settings, gone

    def check(settings: Settings, gone: str) -> None:
        with opened(settings) as (database, archives):
            rows = submissions.archive_rows(database)
            assert archives.ids() >= {name for name, row in rows.items() if row}, "deleted before its row says so"
            archives.finish_deletions(rows)  # As at a start.
            assert archives.ids() == {name for name, row in rows.items() if row}
        assert_sound(settings)
        operation(settings, gone)
        with opened(settings) as (_, archives):
            assert archives.ids() == set(kept)

    kill_everywhere(operation, check, prepare)


def rescore(settings: Settings) -> None:
    with opened(settings) as (database, _):
        jobs.serve_dataset(database, OTHER_DIGEST, rescore=True)
        score_all(database)


@pytest.mark.slow
def test_killed_rescoring_keeps_every_result(tmp_path: Path, new_database: Callable[[], str]) -> None:
    boards = iter(range(MAX_OPERATIONS))
    ids: list[str] = []
    both = frozenset({DIGEST, OTHER_DIGEST})

    def prepare() -> tuple[object, ...]:
        settings = board_settings(tmp_path / f"state-{next(boards)}", db=new_database())
        token = make_board(settings)
        ids[:] = [add_submission(settings, token, content) for content in (b"1", b"2", b"3")]
        free_archive(settings, ids[0])
        return (settings,)

    def check(settings: Settings) -> None:
        found = facts(settings)
        assert found[ids[0]] == ("scored", frozenset({DIGEST}), False)
        for name in ids[1:]:
            status, of_results, has_archive = found[name]
            assert has_archive
            assert DIGEST in of_results
            assert status in ("queued", "scoring", "scored")
        rescore(settings)
        assert [facts(settings)[name] for name in ids[1:]] == [("scored", both, True)] * 2

    kill_everywhere(rescore, check, prepare)
