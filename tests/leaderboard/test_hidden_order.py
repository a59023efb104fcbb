"""Boards with hidden ground truth in one process: ranks, caches, both modes on one database, old results."""

from __future__ import annotations

import json
import random
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
from fastapi import FastAPI

from leaderboard.db.engine import Database
from leaderboard.db.models import LeaderboardRowModel, PictureImageModel, PictureModel, ResultModel
from leaderboard.db.rankings import picture_facts, read_ranking
from leaderboard.db.submissions import result_json
from leaderboard.db.tokens import create_token
from leaderboard.service import open_service
from leaderboard.settings import read_settings
from leaderboard.web.app import make_app
from tests.leaderboard.test_cache import API, BOARD, CSV, add_scored_submission, digest_of_board, get_response
from tests.synthetic_dataset import write_dataset


@pytest.fixture
def state(tmp_path: Path) -> Path:
    write_dataset(tmp_path / "dataset", ["lattice", "pile"], 1)
    return tmp_path / "state"


@pytest.fixture
def database(state: Path) -> Iterator[Database]:
    with closing(Database(f"sqlite:///{state / 'leaderboard.sqlite'}")) as opened:
        opened.migrate()
        yield opened


@pytest.fixture
def hidden(state: Path, database: Database) -> Iterator[Database]:
    """Open the same database for a board that hides the ground truth."""
    with closing(Database(f"sqlite:///{state / 'leaderboard.sqlite'}", hidden_truth=True)) as opened:
        yield opened


@pytest.fixture
def apps(state: Path) -> Iterator[list[FastAPI]]:
    """Return three applications on one database, of which the second hides the ground truth."""
    values = {"data": str(state.parent / "dataset"), "state_dir": state}
    with ExitStack() as stack:
        settings = [read_settings(None, {**values, "hidden_truth": hidden}) for hidden in (False, True, False)]
        yield [make_app(stack.enter_context(open_service(one))) for one in settings]


def set_errors(database: Database, errors: dict[str, float]) -> None:
    """Store rank errors of ``lattice``."""
    with database.write() as session:
        for submission_id, error in errors.items():
            row = session.get_one(LeaderboardRowModel, (submission_id, "lattice"))
            row.rank_error, row.json = error, json.dumps({**json.loads(row.json), "rank_error": error})


def test_order_and_ranks_use_rounded_errors(database: Database, hidden: Database) -> None:
    token = create_token(database, "alice")
    rng = random.Random(7)
    exact = [0.0625, 0.0624, 0.0626, 0.06249, 0.0635, *(round(rng.uniform(0.06, 0.065), 12) for _ in range(15))]
    ids = [add_scored_submission(database, token, f"m{k}", 1.0) for k in range(len(exact))]
    set_errors(database, dict(zip(ids, exact, strict=True)))
    digest = digest_of_board(database)
    entries = read_ranking(hidden, "lattice", digest).entries
    shown = [json.loads(entry.table_json)["rank_error"] for entry in entries]
    assert shown == sorted(round(error, 3) for error in exact)
    assert [entry.rank for entry in entries] == [1 + sum(other < error for other in shown) for error in shown]
    ages = [(error, entry.created_at) for error, entry in zip(shown, entries, strict=True)]
    assert ages == sorted(ages), "rows with equal errors are in order of age, not of their exact errors"
    assert [entry.rank for entry in read_ranking(database, "lattice", digest).entries] == list(
        range(1, len(exact) + 1)
    )


def test_option_changes_responses_of_the_same_database_and_their_etags(
    apps: list[FastAPI], database: Database
) -> None:
    submission_id = add_scored_submission(database, create_token(database, "alice"), "m", 1.0)
    shown, hiding, shown_again = apps
    for address in ("/", BOARD, API, CSV, f"/submissions/{submission_id}"):
        status, headers, body = get_response(shown, address)
        hidden_status, hidden_headers, hidden_body = get_response(hiding, address, if_none_match=headers["etag"])
        assert (status, hidden_status) == (200, 200), address
        assert headers["etag"] != hidden_headers["etag"], address
        assert len(hidden_body) < len(body), address
        again = get_response(shown_again, address, if_none_match=hidden_headers["etag"])
        assert (again[0], again[2]) == (200, body), address
    path = f"/api/v1/submissions/{submission_id}/result.json"
    whole, disclosed, whole_again = (get_response(app, path)[2] for app in apps)
    assert whole == whole_again == result_json(database, submission_id)
    assert json.loads(disclosed)["hidden_truth"] is True


def test_stored_pictures_are_not_returned(apps: list[FastAPI], database: Database, hidden: Database) -> None:
    submission_id = add_scored_submission(database, create_token(database, "alice"), "m", 1.0)
    with database.write() as session:
        session.add(PictureModel(submission_id=submission_id, view_id="lattice/0000", facts="{}"))
        session.add(
            PictureImageModel(submission_id=submission_id, view_id="lattice/0000", kind="error", webp=b"webp")
        )
    shown: dict[str, tuple[dict[str, str], list[str]]] = {"lattice/0000": ({}, ["error"])}
    assert [picture_facts(one, submission_id) for one in (database, hidden)] == [shown, {}]
    path = f"/submissions/{submission_id}/pictures/error/lattice/0000.webp"
    assert [get_response(app, path)[0] for app in apps] == [200, 404, 200]


def test_results_of_other_protocols_are_shown_without_error(apps: list[FastAPI], database: Database) -> None:
    app = apps[1]
    token = create_token(database, "alice")
    known, unknown = (add_scored_submission(database, token, name, 1.0) for name in ("known", "unknown"))
    with database.write() as session:
        result = session.get_one(ResultModel, unknown)
        result.json = b'{"protocol": "rebar-9", "tables": {"lattice": {"rank_error": 0.1}}}'
    for address in ("/", BOARD, CSV):
        assert get_response(app, address)[0] == 200
    rows = json.loads(get_response(app, API)[2])["rows"]
    assert [(row["id"], row["rank"]) for row in rows] == [(known, 1), (unknown, 1)]
    assert b"another version" in get_response(app, f"/submissions/{unknown}")[2]
    answer = json.loads(get_response(app, f"/api/v1/submissions/{unknown}")[2])
    assert answer["result"] == {"hidden_truth": True}
