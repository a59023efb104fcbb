"""Kills at every commit, rename and deletion of backup, prune, retention and rescoring: nothing is lost."""

from __future__ import annotations

import os
import shutil
import signal
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from leaderboard.db import jobs, submissions
from leaderboard.settings import Settings
from leaderboard.storage.archive_store import ArchiveStore
from leaderboard.storage.backup import back_up
from leaderboard.storage.retention import prune_archives
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
