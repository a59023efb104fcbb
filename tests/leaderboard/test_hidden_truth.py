"""Hidden ground truth: what a server with ``--hidden-truth`` returns to submitters who probe for it, and ranks."""

from __future__ import annotations

import csv
import io
import json
import random
import re
import sqlite3
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi import FastAPI

from leaderboard.db.engine import Database
from leaderboard.db.models import LeaderboardRowModel, PictureImageModel, PictureModel, ResultModel
from leaderboard.db.rankings import picture_facts, read_ranking
from leaderboard.db.submissions import result_json
from leaderboard.db.tokens import create_token
from leaderboard.service import open_service
from leaderboard.web.app import make_app
from rebar_depth_bench import SubmissionWriter, load
from rebar_depth_bench.scoring.protocol import scored_pixels
from tests.leaderboard.boards import add_scored_submission, board_settings, digest_of_board, get_response
from tests.leaderboard.serving import API, RunServer, Server, run_bench
from tests.synthetic_dataset import write_dataset

CONFIG, VIEWS = "lattice", 9
PROBED, REPLACED, OMITTED = (f"{CONFIG}/{index:04d}" for index in (140, 252, 364))
ROWS, CSV = f"/api/v1/leaderboard?config={CONFIG}", f"/api/v1/leaderboard.csv?config={CONFIG}"

Change = Callable[[str, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Probes:
    """A server that hides the ground truth of a leaderboard that showed it, its token, and submissions by kind.

    ``results`` are those of the submissions that were scored before the option was given, and ``printed`` is what
    ``rebar-bench submit`` printed for the submission ``view``.
    """

    server: Server
    token: str
    ids: Mapping[str, str]
    results: Mapping[str, dict[str, Any]]
    printed: str

    def submission(self, name: str) -> dict[str, Any]:
        """Return the JSON of a submission."""
        return dict(self.server.get(f"{API}/{self.ids[name]}").json())

    def table(self, name: str) -> dict[str, Any]:
        """Return what is returned of the table of a submission."""
        return dict(self.submission(name)["result"]["tables"][CONFIG])


@pytest.fixture(scope="module")
def write_constant(tiny_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Write an archive with one depth per view, of one method; ``change`` may replace the depth of a view."""
    rows = list(load(tiny_root, CONFIG, columns=["view_id", "left_depth"]))

    def write(depths_m: Mapping[str, float] | float, change: Change = lambda _, depth_m: depth_m) -> Path:
        path = tmp_path_factory.mktemp("archive") / "submission.zip"
        with SubmissionWriter(path, "constant", inputs="rgb", uses_ground_truth=False) as writer:
            for row in rows:
                value = depths_m if isinstance(depths_m, float) else depths_m[row["view_id"]]
                depth_m = np.full(row["left_depth"].shape, value, dtype=np.float32)
                writer.add(row["view_id"], change(row["view_id"], depth_m))
        return path

    return write


@pytest.fixture(scope="module")
def probes(tiny_root: Path, running_server: RunServer, write_constant: Callable[..., Path]) -> Iterator[Probes]:
    rows = load(tiny_root, CONFIG, columns=["view_id", "left_depth", "left_mask"])
    probed = next(row for row in rows if row["view_id"] == PROBED)
    pixel = int(scored_pixels(probed["left_mask"], probed["left_depth"])[0])

    def one_pixel(view_id: str, depth_m: np.ndarray) -> np.ndarray:
        if view_id == PROBED:
            depth_m.flat[pixel] = 1e12
        return depth_m

    def one_view(view_id: str, depth_m: np.ndarray) -> np.ndarray:
        return np.full_like(depth_m, 1e12) if view_id == REPLACED else depth_m

    def omitted(view_id: str, depth_m: np.ndarray) -> np.ndarray:
        return np.zeros_like(depth_m) if view_id == OMITTED else depth_m

    ids: dict[str, str] = {}
    results: dict[str, dict[str, Any]] = {}
    with running_server(error_maps=1, quota=6) as server:
        token = server.token("attacker")

        def score_now(name: str, archive: Path) -> None:
            ids[name] = server.submit_accepted(archive, token)
            results[name] = server.wait_until_ended(ids[name])["result"]

        score_now("constant", write_constant(1.0))
        scales = {view["view_id"]: view["scale"] for view in results["constant"]["views"]}
        score_now("corrected", write_constant(scales))
        score_now("omitted before", write_constant(1.0, omitted))
    with running_server(server.state, hidden_truth=True, quota=6) as server:
        for name, change in (("pixel", one_pixel), ("omitted", omitted)):
            ids[name] = server.submit_accepted(write_constant(1.0, change), token)
            server.wait_until_ended(ids[name])
        submitted = run_bench("submit", write_constant(1.0, one_view), "--url", server.url, token=token)
        ids["view"] = re.findall(r"/submissions/(\w+)", submitted.stderr)[0]
        yield Probes(server, token, ids, results, submitted.stdout)


def test_attack_by_scales_works_on_a_board_that_publishes_them(probes: Probes) -> None:
    errors = [probes.results[name]["tables"][CONFIG]["native"]["abs_rel"] for name in ("constant", "corrected")]
    assert errors[1] < errors[0] / 5
    assert probes.results["omitted before"]["tables"][CONFIG]["views_scored"] == VIEWS - 1


def test_result_has_rank_error_and_coverage_alone(probes: Probes) -> None:
    whole = probes.results["constant"]
    expected = {key: whole[key] for key in ("protocol", "dataset", "submission", "software")}
    table = whole["tables"][CONFIG]
    expected["tables"] = {
        CONFIG: {"ranked": True, **{key: round(table[key], 3) for key in ("coverage", "rank_error")}}
    }
    expected["hidden_truth"] = True
    assert probes.server.get(f"{API}/{probes.ids['constant']}/result.json").json() == expected
    assert probes.submission("constant")["result"] == expected
    row = next(row for row in probes.server.get(ROWS).json()["rows"] if row["id"] == probes.ids["constant"])
    assert row["table"] == expected["tables"][CONFIG]
    assert (row["inputs"], row["uses_ground_truth"]) == ("rgb", False)


def get_paths(probes: Probes) -> Iterator[str]:
    """Yield every path that can be read: those of the OpenAPI document, with all ids, and the pages."""
    document = probes.server.get("/openapi.json").json()
    for path, operations in document["paths"].items():
        if "{submission_id}" in path and "get" in operations:
            yield from (path.replace("{submission_id}", submission_id) for submission_id in probes.ids.values())
        elif "get" in operations:
            yield path
    yield from (
        ROWS,
        CSV,
        f"{ROWS}&inputs=rgb",
        f"{CSV}&inputs=rgb",
        "/openapi.json",
        "/how-to-submit",
        "/nothing",
    )
    sorts = ("rank_error", "-coverage", "rmse", "scale", "method")
    yield from ("/", "/?inputs=rgb", f"/?config={CONFIG}", *(f"/?config={CONFIG}&sort={name}" for name in sorts))
    for submission_id in probes.ids.values():
        yield from (f"/submissions/{submission_id}", f"/submissions/{submission_id}?views={CONFIG}")
    query = "SELECT submission_id, view_id FROM picture_images WHERE kind = 'error'"
    for submission_id, view_id in stored(probes, query):
        yield f"/submissions/{submission_id}/pictures/error/{view_id}.webp"


def stored(probes: Probes, query: str) -> list[tuple[Any, ...]]:
    """Return rows of the database of the server."""
    with closing(sqlite3.connect(probes.server.state / "leaderboard.sqlite")) as connection:
        return list(connection.execute(query))


@pytest.fixture(scope="module")
def texts(probes: Probes) -> dict[str, str]:
    """Return the text of all responses: for programs, for browsers and for the owner, by path and kind."""
    owner = {"Authorization": f"Bearer {probes.token}"}
    kinds = {"program": {}, "browser": {"Accept": "text/html"}, "owner": owner}
    responses = {
        f"{path} {kind}": probes.server.get(path, headers=headers)
        for path in get_paths(probes)
        for kind, headers in kinds.items()
    }
    assert sum("/pictures/" in path for path in responses) == 18
    assert all(response.status_code == 404 for path, response in responses.items() if "/pictures/" in path)
    types = {response.headers["content-type"] for response in responses.values()}
    assert all(one.startswith(("text/", "application/json")) for one in types)
    return {path: response.text for path, response in responses.items()}


_NO_SCORES = re.compile(
    r"\d{4}-\d\d-\d\dT[\d:.]+Z|[\d.]+ (?:bytes|[KMG]iB)|\d+(?:\.\d+){2,}\S*|cc-by-4\.0|\b[0-9a-f]{32,64}\b"
)
"""Times, sizes, versions, addresses and digests."""


def numbers_in(text: str) -> set[str]:
    """Return the numbers in a response, without those that are no scores."""
    return set(re.findall(r"\d+(?:\.\d+)?(?:e[+-]?\d+)?", _NO_SCORES.sub("", text)))


def test_responses_contain_no_other_numbers(probes: Probes, texts: Mapping[str, str]) -> None:
    tables = [probes.table(name) for name in probes.ids if name != "omitted"]
    shown = {value for table in tables for value in (table["coverage"], table["rank_error"])}
    assert all(value == round(value, 3) for value in shown)
    allowed = {text for value in shown for text in (str(value), f"{value:.3f}", f"{value * 100:.1f}")}
    # The mean over the two configs, of which these submissions lack one, follows from the disclosed numbers.
    allowed |= {f"{(table['rank_error'] + 1) / 2:.3f}" for table in tables}
    for path, text in texts.items():
        assert {number for number in numbers_in(text) if "." in number} <= allowed, path


def leaves(part: Any) -> Iterator[int | float]:
    """Yield the numbers of JSON data."""
    if isinstance(part, dict | list):
        for value in part.values() if isinstance(part, dict) else part:
            yield from leaves(value)
    elif isinstance(part, int | float) and not isinstance(part, bool):
        yield part


def test_responses_contain_no_stored_number(probes: Probes, texts: Mapping[str, str]) -> None:
    """Numbers of four and more digits are searched in all forms in which pages, tables and JSON write them."""
    results = [json.loads(row[0]) for row in stored(probes, "SELECT json FROM results")]
    assert len(results) == 5
    forms = {form.format(number) for number in leaves(results) for form in ("{!r}", "{:.4f}", "{:.4g}", "{:.6g}")}
    secret = {form for form in forms if len(re.sub(r"^[0.]+|\.", "", form.rstrip("0"))) >= 4}
    assert len(secret) > 500
    assert numbers_in(json.dumps(probes.results)) & secret
    for path, text in texts.items():
        assert not numbers_in(text) & secret, path


def test_page_and_csv_show_disclosed_numbers(probes: Probes) -> None:
    table = probes.table("constant")
    page = probes.server.get(f"/submissions/{probes.ids['constant']}").text
    for value in (table["rank_error"], table["coverage"]):
        assert f'data-value="{value}"' in page
    assert f"{table['rank_error']:.3f}<" in probes.server.get(f"/?config={CONFIG}").text
    rows = list(csv.DictReader(io.StringIO(probes.server.get(CSV).text)))
    assert list(rows[0])[-4:] == ["config", "coverage", "ranked", "rank_error"]
    assert {row["id"]: float(row["rank_error"]) for row in rows}[probes.ids["constant"]] == table["rank_error"]


def test_one_pixel_changes_nothing(probes: Probes) -> None:
    assert probes.table("pixel") == probes.table("constant")
    rows = {row["id"]: row for row in probes.server.get(ROWS).json()["rows"]}
    own, constant = (rows[probes.ids[name]] for name in ("pixel", "constant"))
    changed = {key for key in own if own[key] != constant[key]}
    assert changed == {"id", "created_at"}, "equal errors share a rank"
    pages = [probes.server.get(f"/submissions/{probes.ids[name]}").text for name in ("pixel", "constant")]
    assert len({re.search(r"<h2 id=.results.*?</section>", page, re.DOTALL)[0] for page in pages}) == 1  # type: ignore[index]


def test_one_view_changes_the_rank_error_by_its_share(probes: Probes) -> None:
    before, after = probes.table("constant"), probes.table("view")
    assert 0 < after.pop("rank_error") - before.pop("rank_error") <= 1 / VIEWS + 0.001
    assert after == before


def test_view_of_low_coverage_fails_without_details(probes: Probes) -> None:
    submission = probes.submission("omitted")
    assert (submission["status"], submission["result"]) == ("failed", None)
    assert "predictions for at least 50 % of the scored pixels of each view" in submission["reason"]
    assert CONFIG not in submission["reason"]
    assert re.findall(r"\d+", submission["reason"]) == ["1", "50"]
    assert probes.ids["omitted"] not in probes.server.get(ROWS).text
    token = probes.server.get("/api/v1/token", probes.token).json()
    assert token["quota_left"] == 0, "a failed submission counts"


def test_scores_from_before_are_kept(probes: Probes) -> None:
    assert probes.submission("omitted before")["status"] == "scored"
    assert probes.table("corrected")["rank_error"] < probes.table("constant")["rank_error"]


def test_ranks_of_pages_are_those_of_the_board(probes: Probes) -> None:
    for row in probes.server.get(ROWS).json()["rows"]:
        assert f"{CONFIG} rank {row['rank']}." in probes.server.get(f"/submissions/{row['id']}").text


def test_command_prints_disclosed_numbers(probes: Probes) -> None:
    error = probes.table("view")["rank_error"]
    assert (
        probes.printed
        == f"constant, protocol rebar-2, ground truth hidden\n{CONFIG}: rank error {error:.3f}, coverage 100.0 %\n"
    )


@pytest.fixture
def state(tmp_path: Path) -> Path:
    write_dataset(tmp_path / "dataset", ["lattice", "pile"], 1)
    return tmp_path / "state"


@pytest.fixture
def boards(state: Path) -> Iterator[list[Database]]:
    """Yield the database as a leaderboard opens it that shows the ground truth, and as one that hides it."""
    url = f"sqlite:///{state / 'leaderboard.sqlite'}"
    with closing(Database(url)) as database, closing(Database(url, hidden_truth=True)) as hidden:
        database.migrate()
        yield [database, hidden]


@pytest.fixture
def apps(state: Path) -> Iterator[list[FastAPI]]:
    """Return three applications on one database, of which the second hides the ground truth."""
    data = str(state.parent / "dataset")
    with ExitStack() as stack:
        settings = [board_settings(state, data=data, hidden_truth=hidden) for hidden in (False, True, False)]
        yield [make_app(stack.enter_context(open_service(one))) for one in settings]


@pytest.mark.slow
def test_order_and_ranks_use_rounded_errors(boards: list[Database]) -> None:
    database, hidden = boards
    token = create_token(database, "alice")
    rng = random.Random(7)
    exact = [0.0625, 0.0624, 0.0626, 0.06249, 0.0635, *(round(rng.uniform(0.06, 0.065), 12) for _ in range(15))]
    ids = [add_scored_submission(database, token, f"m{k}", 1.0) for k in range(len(exact))]
    with database.write() as session:
        for submission_id, error in zip(ids, exact, strict=True):
            row = session.get_one(LeaderboardRowModel, (submission_id, "lattice"))
            row.rank_error, row.json = error, json.dumps({**json.loads(row.json), "rank_error": error})
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


@pytest.mark.slow
def test_option_changes_responses_of_the_same_database_and_their_etags(
    apps: list[FastAPI], boards: list[Database]
) -> None:
    database = boards[0]
    submission_id = add_scored_submission(database, create_token(database, "alice"), "m", 1.0)
    shown, hiding, shown_again = apps
    for address in ("/", f"/?config={CONFIG}", ROWS, CSV, f"/submissions/{submission_id}"):
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


def test_stored_pictures_are_not_returned(apps: list[FastAPI], boards: list[Database]) -> None:
    database = boards[0]
    submission_id = add_scored_submission(database, create_token(database, "alice"), "m", 1.0)
    with database.write() as session:
        session.add(PictureModel(submission_id=submission_id, view_id="lattice/0000", facts="{}"))
        view = {"submission_id": submission_id, "view_id": "lattice/0000"}
        session.add(PictureImageModel(**view, kind="error", webp=b"webp"))
    shown: dict[str, tuple[dict[str, str], list[str]]] = {"lattice/0000": ({}, ["error"])}
    assert [picture_facts(one, submission_id) for one in boards] == [shown, {}]
    path = f"/submissions/{submission_id}/pictures/error/lattice/0000.webp"
    assert [get_response(app, path)[0] for app in apps] == [200, 404, 200]


@pytest.mark.slow
def test_results_of_other_protocols_are_shown_without_error(apps: list[FastAPI], boards: list[Database]) -> None:
    app, database = apps[1], boards[0]
    token = create_token(database, "alice")
    known, unknown = (add_scored_submission(database, token, name, 1.0) for name in ("known", "unknown"))
    with database.write() as session:
        result = session.get_one(ResultModel, unknown)
        result.json = b'{"protocol": "rebar-9", "tables": {"lattice": {"rank_error": 0.1}}}'
    for address in ("/", f"/?config={CONFIG}", CSV):
        assert get_response(app, address)[0] == 200
    rows = json.loads(get_response(app, ROWS)[2])["rows"]
    assert [(row["id"], row["rank"]) for row in rows] == [(known, 1), (unknown, 1)]
    assert b"another version" in get_response(app, f"/submissions/{unknown}")[2]
    answer = json.loads(get_response(app, f"/api/v1/submissions/{unknown}")[2])
    assert answer["result"] == {"hidden_truth": True}
