"""Pages of a real server without JavaScript."""

from __future__ import annotations

import json
import math
import re
import zipfile
from pathlib import Path
from typing import Any

import httpx2
import pytest

from cards.dataset import PRETTY_NAME
from rebar_depth_bench.reporting.tables import comparison_cells
from rebar_depth_bench.scoring.comparison import compare
from rebar_depth_bench.scoring.reading import read_result
from tests.bench.reporting.pages import Page
from tests.leaderboard.boards import OTHER_DIGEST
from tests.leaderboard.conftest import HOSTILE, LINKS, SharedServer, WriteArchive

CONFIGS = ("lattice", "lattice-orbit")
BROWSER = {"Accept": "text/html,application/xhtml+xml,*/*;q=0.8"}


def get(url: str, **options: Any) -> httpx2.Response:
    return httpx2.get(url, headers={**BROWSER, **options.pop("headers", {})}, timeout=60, **options)


def page(url: str) -> tuple[httpx2.Response, Page]:
    """Return a page after checks of nesting, landmarks, a single h1 and the absence of inline code."""
    response = get(url)
    parsed = Page(response.text)
    assert parsed.count("h1") == parsed.count("main") == parsed.count("footer") == 1
    assert parsed.attributes_of("a")[0]["class"] == "skip"
    assert not any(
        "style" in attributes or any(name.startswith("on") for name in attributes) for _, attributes in parsed.tags
    )
    assert all("src" in script for script in parsed.attributes_of("script"))
    assert all(link.get("href") for link in parsed.attributes_of("a"))
    return response, parsed


def names_in_order(text: str, config: str = "lattice") -> list[str]:
    """Return the method names in the table of a config, from top to bottom."""
    table = text[text.index(f'aria-label="Table of {config}"') :]
    table = table[: table.index("</table>")]
    return re.findall(r'<a [^>]*href="/submissions/[^>]+><bdi>([^<]+)</bdi>', table)


def row_of(text: str, submission_id: str) -> str:
    """Return the row of a submission in the first table that has it."""
    place = text.index(f"/submissions/{submission_id}")
    return text[text.rindex("<tr>", 0, place) : text.index("</tr>", place) + 5]


def test_leaderboard_page_shows_ranks_and_marks(board: SharedServer) -> None:
    response, parsed = page(board.url + "/")
    assert response.headers["cache-control"] == "no-cache"
    assert names_in_order(response.text)[0] == "good"
    assert names_in_order(response.text)[-1] == "holes"
    assert "not ranked" in parsed.text
    assert re.search(r"coverage \d\d\.\d % is below 95 %", parsed.text)
    assert "the submission declares that it uses ground truth" in parsed.text
    assert "use of ground truth not declared" in parsed.text
    reference = response.text.index('class="rank">reference<')
    assert response.text.index("holes") < reference
    assert "FoundationStereo" not in response.text, "the dataset has nine views, the paper's 504"
    assert "95 % interval, block bootstrap" in parsed.text
    digest = board.server.get("/healthz").json()["dataset"]
    assert digest in parsed.text
    assert "rebar-2" in parsed.text


def test_leaderboard_page_shows_values_of_api(board: SharedServer) -> None:
    text = get(f"{board.url}/?config=lattice").text
    for row in board.server.rows():
        table, line = row["table"], row_of(text, row["id"])
        low, high = table["ci95"]["rank_error"]
        assert [re.sub("<.*", "", cell) for cell in line.split("<td>")[1:]] == [
            f"{table['rank_error']:.4f}",
            f"{math.floor(1000 * table['coverage']) / 10}",
            f"{table['native']['abs_rel']:.4f}",
            f"{table['native']['rmse_cm']:.2f}",
            f"{table['scaled']['abs_rel']:.4f}",
            f"{table['scaled']['rmse_cm']:.2f}",
            f"{table['scale_median']:.3f}",
            f"{100 * table['within_mm']['5']:.1f}",
            "",
        ]
        assert f"{low:.4f}–{high:.4f}" in line
        assert (f"<b>{row['rank']}</b>" if row["rank"] else "not ranked") in line


def test_baseline_and_repeated_rows(crowded: SharedServer) -> None:
    """The page shows the best row of each submitter and method name, and all of them on request."""
    addresses = ("/?config=lattice", "/?config=lattice&rows=all")
    for address, other, shows_worse in (*addresses, False), (*addresses[::-1], True):
        response, parsed = page(crowded.url + address)
        links = [str(link["href"]) for link in parsed.attributes_of("a")]
        assert other in links
        [csv] = [crowded.server.get(link).text for link in links if "leaderboard.csv" in link]
        for text in (response.text, csv):
            assert (crowded.ids["worse"] in text, crowded.ids["method 3"] in text) == (shows_worse, True)
        assert response.text.count('name="id"') == len(csv.splitlines()) - 1
        assert "baseline org" in Page(row_of(response.text, crowded.ids["baseline"])).text
        assert response.text.count("baseline</b>") == 1
    overview = get(f"{crowded.url}/").text
    assert crowded.ids["worse"] not in overview
    assert crowded.ids["worse"] in get(f"{crowded.url}/?rows=all").text


@pytest.mark.parametrize("query", ["page=abc", "page=", "rows=%00&sort=%00&inputs=%00", f"page={'9' * 5000}"])
def test_invalid_parameters_are_replaced_by_their_defaults(crowded: SharedServer, query: str) -> None:
    response, _ = page(f"{crowded.url}/?config=lattice&{query}")
    assert response.status_code == 200
    assert names_in_order(response.text) == names_in_order(get(f"{crowded.url}/?config=lattice").text)
    assert page(crowded.page("huge") + "?views=%00")[0].status_code == 200


def test_page_shows_the_rows_of_a_search(board: SharedServer) -> None:
    every = names_in_order(get(f"{board.url}/?config=lattice").text)
    for query, names in (("inputs=rgb%2BK", ["near"]), ("q=FAR", ["far"]), ("q=müller", every), ("q=nobody", [])):
        assert names_in_order(get(f"{board.url}/?config=lattice&{query}").text) == names
    csv = board.server.get("/api/v1/leaderboard.csv?config=lattice&inputs=stereo").text
    assert [line.split(",")[3] for line in csv.splitlines()[1:]] == ["holes"]


def test_texts_of_submissions_are_escaped(board: SharedServer) -> None:
    for address in (f"{board.url}/", board.page("hostile")):
        response, parsed = page(address)
        assert "<script>alert" not in response.text
        assert "<b>second" not in response.text
        assert HOSTILE in parsed.text
        assert "Müller & <Söhne>" in parsed.text
        assert not set(response.text) & set("\u202e\x1b")
    links = page(board.page("hostile"))[1].attributes_of("a")
    shown = [(link["href"], link["rel"]) for link in links if "example.org" in str(link["href"])]
    assert shown == [("https://example.org/?a=1&b=<i>", "nofollow noopener noreferrer")]


def test_page_of_scored_submission(board: SharedServer) -> None:
    response, parsed = page(board.page("far"))
    rows = board.server.rows()
    [rank] = [row["rank"] for row in rows if row["id"] == board.ids["far"]]
    assert f"Scored : lattice rank {rank} of {len(rows)} rows." in parsed.text
    assert "http-equiv" not in response.text
    assert f"/api/v1/submissions/{board.ids['far']}/result.json" in response.text
    result = board.server.get(f"/api/v1/submissions/{board.ids['far']}/result.json").json()
    worst = max(result["views"], key=lambda view: view["rank_error"])["view_id"]
    table = response.text[response.text.index("the worst 9 of 9 views") :]
    assert re.findall(r'class="name">(lattice/\d{4})<', table)[0] == worst
    assert f"Scored against dataset {result['dataset']['digest']}" in parsed.text
    every = page(board.page("good") + "?views=lattice-orbit")[1].text
    assert "lattice-orbit: all 2 views, worst first" in every


def test_page_of_queued_submission(waiting: SharedServer) -> None:
    response, parsed = page(waiting.page("later"))
    assert re.search(r"number 2 of \d in the queue", parsed.text)
    assert re.search(r"number 1 of \d in the queue", page(waiting.page("next"))[1].text)
    assert "Not on the leaderboard" in parsed.text
    assert '<noscript><meta http-equiv="refresh" content="5"></noscript>' in response.text
    assert response.headers["cache-control"] == "no-store"
    assert "scoring took longer than the limit of 0.01 s" in page(waiting.page("failed"))[1].text


def test_page_of_outdated_submission_shows_its_result_and_why(crowded: SharedServer) -> None:
    _, parsed = page(crowded.page("outdated"))
    assert re.search(f"Outdated : the result belongs to the dataset {OTHER_DIGEST} .*; its archive", parsed.text)
    assert f"Scored against dataset {OTHER_DIGEST}" in parsed.text
    assert "lattice: the worst 10 of 80 views" in parsed.text
    assert "lattice rank" not in parsed.text


def test_account_shows_what_is_left_of_the_quota_and_ranks(
    board: SharedServer, crowded: SharedServer, waiting: SharedServer
) -> None:
    own, many, private = (
        Page(one.server.call("POST", "/account", data={"token": one.token}, headers=BROWSER).text).text
        for one in (board, crowded, waiting)
    )
    left = board.server.get("/api/v1/token", board.token).json()["quota_left"]
    assert 0 < left < 100
    assert f"{left} of 100 submissions and" in own
    rows = {row["id"]: row for row in crowded.server.rows()}
    for row in (rows[crowded.ids["worse"]], rows[crowded.ids["huge"]]):
        assert f"lattice rank {row['rank']}, rank error {row['table']['rank_error']:.4f}" in many
    assert "lattice not ranked, rank error 0.0099" in many
    [row] = waiting.server.rows(waiting.token)
    assert "scored · not public" in private
    assert f"lattice rank error {row['table']['rank_error']:.4f}" in private


def test_overview_orders_by_the_mean_over_configs(board: SharedServer) -> None:
    table = get(f"{board.url}/").text.partition('aria-label="Ranks in all configs"')[2].partition("</table>")[0]
    rows = {config: board.server.rows(config=config) for config in CONFIGS}
    errors = {name: {row["id"]: row["table"]["rank_error"] for row in rows[name]} for name in CONFIGS}
    ranked = {row["id"] for config_rows in rows.values() for row in config_rows if row["rank"]}
    means = {one: sum(errors[config].get(one, 1.0) for config in CONFIGS) / len(CONFIGS) for one in ranked}
    shown = re.findall(r'href="/submissions/([^"]+)"', table)
    assert shown[: len(ranked)] == sorted(ranked, key=means.__getitem__)
    assert set(shown[len(ranked) :]) == {board.ids["holes"]}
    for submission_id, mean in means.items():
        assert f"<td>{mean:.4f}</td>" in row_of(table, submission_id)
    assert board.ids["far"] not in errors["lattice-orbit"], "a config that is missing counts 1"
    assert means[board.ids["far"]] > 0.5
    overall = board.server.get("/api/v1/overall").json()["rows"]
    assert [row["id"] for row in overall] == shown
    assert {row["id"]: row["mean_rank_error"] for row in overall if row["rank"]} == pytest.approx(means)


def test_comparison_page_shows_the_numbers_of_the_command_line(board: SharedServer) -> None:
    first, other = (
        read_result(board.server.get(f"/api/v1/submissions/{board.ids[name]}/result.json").content, name)
        for name in ("good", "near")
    )
    _, parsed = page(f"{board.url}/compare?id={board.ids['good']}&id={board.ids['near']}")
    for differences in compare(first, other).configs.values():
        for difference in differences:
            assert " ".join(filter(None, comparison_cells(difference))) in " ".join(parsed.text.split())
    far = f"{board.url}/compare?id={board.ids['far']}&id={board.ids['good']}"
    assert "lattice-orbit" not in page(far)[1].text.split("Paired comparison")[1].split("B - A:")[0]


@pytest.mark.parametrize(
    ("names", "status", "words"),
    [
        ((), 422, "0 rows ticked, expected two"),
        (("huge", "huge"), 422, "1 row ticked, expected two"),
        (("huge", "worse", "truth"), 422, "3 rows ticked, expected two"),
        (("huge", "nobody"), 404, "no such submission"),
        (("huge", "%00"), 404, "no such submission"),
        (("huge", "outdated"), 422, "only submissions on the same ground truth can be compared"),
    ],
)
def test_comparison_of_other_than_two_results_is_refused_in_words(
    crowded: SharedServer, names: tuple[str, ...], status: int, words: str
) -> None:
    query = "&".join(f"id={crowded.ids.get(name, name)}" for name in names)
    response, parsed = page(f"{crowded.url}/compare?{query}")
    assert response.status_code == status
    assert words in parsed.text


def test_pages_name_dataset_licence_and_scenes(board: SharedServer) -> None:
    _, parsed = page(board.url + "/")
    assert f"{PRETTY_NAME} , licence cc-by-4.0" in parsed.text
    scenes = [str(image["src"]) for image in parsed.attributes_of("img") if "/scenes/" in str(image["src"])]
    assert scenes == [f"/scenes/{config}.webp" for config in CONFIGS]
    for source in scenes:
        assert get(board.url + source).content[8:12] == b"WEBP"
    assert get(f"{board.url}/scenes/nope.webp").status_code == 404


def test_links_of_dataset_and_paper_are_shown(crowded: SharedServer) -> None:
    for path in ("/", "/how-to-submit"):
        _, parsed = page(crowded.url + path)
        assert {link["href"] for link in parsed.attributes_of("a")} >= set(LINKS.values())
    assert f"url = {{{LINKS['paper_url']}}}" in parsed.text


def test_details_and_possible_mistakes_of_a_method_are_shown(
    board: SharedServer, write_archive: WriteArchive
) -> None:
    details = {"licence": "Apache-2.0", "training_data": "KITTI and <NYU>", "parameters": 24_800_000}
    links = {"code_url": "https://code.example/x", "url": "https://page.example/x"}
    archive = write_archive(
        "detailed", 1000.0, **details, **links, runtime={"seconds": {"a": 0.5, "b": 0.25, "c": 0.75}}
    )
    submission_id = board.server.submit_accepted(archive, board.server.token("detailed owner"))
    board.server.wait_until_ended(submission_id)
    _, parsed = page(f"{board.url}/submissions/{submission_id}")
    shown = ("KITTI and <NYU>", "24,800,000", "Apache-2.0", "0.5 s", "code.example", "page.example")
    for text in (*shown, "seem to be in millimetres"):
        assert text in parsed.text
    row = row_of(get(f"{board.url}/?config=lattice").text, submission_id)
    assert set(links.values()) <= {link["href"] for link in Page(row).attributes_of("a")}
    assert row.endswith("<td>0.5</td></tr>")


@pytest.mark.parametrize("path", ["/nope", "/submissions/nope", "/?config=nope", "/submissions/a%3Cb"])
def test_errors_are_html_for_browsers_and_json_otherwise(board: SharedServer, path: str) -> None:
    response, _ = page(board.url + path)
    assert response.status_code in (404, 422)
    plain = httpx2.get(board.url + path, headers={"Accept": "*/*"})
    assert plain.json()["detail"]
    assert board.server.get("/api/v1/submissions/nope", headers=BROWSER).json() == {"detail": "no such submission"}


@pytest.mark.parametrize("name", ["report.css", "page.css", "page.js", "sortable.js", "icon.svg"])
def test_static_files_are_revalidated(board: SharedServer, name: str) -> None:
    assert f'"/static/{name}"' in get(board.url).text
    response = get(f"{board.url}/static/{name}")
    assert (response.status_code, response.headers["cache-control"]) == (200, "public, no-cache")
    conditional_response = get(f"{board.url}/static/{name}", headers={"If-None-Match": response.headers["etag"]})
    assert (conditional_response.status_code, conditional_response.content) == (304, b"")
    assert get(f"{board.url}/static/..%2F__init__.py").status_code == 404


def post_form(shared: SharedServer, archive: Path, token: str, first: bool = True) -> httpx2.Response:
    """Post the form as a browser does; the token comes before the archive if ``first``."""
    fields: list[tuple[str, Any]] = [
        ("token", (None, token)),
        ("archive", (archive.name, archive.read_bytes(), "application/zip")),
    ]
    fields = fields if first else fields[::-1]
    return shared.server.call("POST", "/submit", files=fields, headers=BROWSER)


def test_form_upload_without_javascript(board: SharedServer, write_archive: WriteArchive) -> None:
    response = post_form(board, write_archive("by form", 3.0), f" {board.token}\n")
    assert response.status_code == 303
    address = response.headers["location"]
    assert address.startswith("/submissions/")
    assert board.server.wait_until_ended(address.rpartition("/")[2])["status"] == "scored"
    assert "by form" in names_in_order(get(board.url).text)


def test_form_rejects_uploads_like_api(waiting: SharedServer, write_archive: WriteArchive, tmp_path: Path) -> None:
    archive, invalid, large = write_archive("x"), tmp_path / "broken.zip", tmp_path / "large.zip"
    with zipfile.ZipFile(invalid, "w") as target:
        target.writestr("submission.json", json.dumps({"method": "x"}))
        target.writestr("lattice/<b>0000.npy", b"x")
    large.write_bytes(bytes(2_100_000))
    cases = [
        (post_form(waiting, archive, "rdb_wrong"), 401, "the token is unknown"),
        (post_form(waiting, archive, ""), 401, "no token"),
        (post_form(waiting, archive, waiting.token, first=False), 401, "no token"),
        (post_form(waiting, archive, "x" * 5000), 401, "no token"),
        (post_form(waiting, invalid, waiting.token), 422, "lattice/<b>0000.npy"),
        (post_form(waiting, large, waiting.token), 413, "the limit of this service"),
    ]
    for response, status, words in cases:
        assert response.status_code == status, response.text
        parsed = Page(response.text)
        assert words in parsed.text
        assert "Not accepted" in parsed.text
        assert waiting.token not in response.text
    api_problems = waiting.server.submit(invalid, waiting.token).json()["problems"]
    shown = Page(cases[4][0].text).text
    assert len(api_problems) > 1
    assert all(" ".join(problem.split()) in shown for problem in api_problems)
    assert not list((waiting.server.state / "spool").glob("*.upload"))
