"""The pages as a browser without JavaScript gets them, from a real server over HTTP."""

from __future__ import annotations

import json
import re
import zipfile
from pathlib import Path
from typing import Any

import httpx2
import pytest

from tests.bench.reporting.pages import Page
from tests.leaderboard.conftest import HOSTILE, Shared, Write

BROWSER = {"Accept": "text/html,application/xhtml+xml,*/*;q=0.8"}


def get(url: str, **options: Any) -> httpx2.Response:
    return httpx2.get(url, headers={**BROWSER, **options.pop("headers", {})}, timeout=60, **options)


def page(url: str) -> tuple[httpx2.Response, Page]:
    """Return a page, checked for what every page has: nesting, landmarks, one h1, nothing inline."""
    answer = get(url)
    parsed = Page(answer.text)
    assert parsed.count("h1") == parsed.count("main") == parsed.count("footer") == 1
    assert parsed.named("a")[0]["class"] == "skip"
    assert not any("style" in found or any(name.startswith("on") for name in found) for _, found in parsed.tags)
    assert all("src" in script for script in parsed.named("script"))
    assert all(link.get("href") for link in parsed.named("a"))
    return answer, parsed


def names_in_order(text: str, config: str = "lattice") -> list[str]:
    """Return the methods of a config's table from top to bottom."""
    table = text[text.index(f'aria-label="Table of {config}"') :]
    table = table[: table.index("</table>")]
    return re.findall(r'<a href="/submissions/[^"]+"><bdi>([^<]+)</bdi>', table)


def test_the_board_ranks_and_marks(board: Shared) -> None:
    answer, parsed = page(board.url + "/")
    assert answer.headers["cache-control"] == "no-cache"
    assert names_in_order(answer.text)[0] == "good"
    assert names_in_order(answer.text)[-1] == "holes"
    assert "not ranked" in parsed.text
    assert re.search(r"coverage \d\d\.\d % is below 95 %", parsed.text)
    published = answer.text.index("Published, not ranked")
    assert answer.text.index("holes") < published < answer.text.index("FoundationStereo")
    assert answer.text.count('class="chart"') == 2
    assert "95 % interval, block bootstrap" in parsed.text
    digest = httpx2.get(f"{board.url}/healthz").json()["dataset"]
    assert digest in parsed.text
    assert "rebar-1" in parsed.text


def test_numbers_on_the_board_are_those_of_the_api(board: Shared) -> None:
    rows = httpx2.get(f"{board.url}/api/v1/leaderboard?config=lattice").json()["rows"]
    text = get(f"{board.url}/?config=lattice").text
    for row in rows:
        start = text.index(f"/submissions/{row['id']}")
        cells = text[start : text.index("</tr>", start)]
        assert f'data-value="{row["table"]["native"]["abs_rel"]}"' in cells
        assert f"{row['table']['scaled']['rmse_cm']:.2f}" in cells
        low, high = row["table"]["ci95"]["native"]["rmse_cm"]
        assert f"{low:.2f}–{high:.2f}" in cells
        before = text[text.rindex("<tr", 0, start) : start]
        assert (f'data-value="{row["rank"]}"' if row["rank"] else "not ranked") in before


@pytest.mark.parametrize(
    ("sort", "key", "falls"),
    [
        ("rmse", lambda table: table["native"]["rmse_cm"], False),
        ("-rmse", lambda table: table["native"]["rmse_cm"], True),
        ("scaled_delta1", lambda table: table["scaled"]["delta1"], True),
        ("within_10mm", lambda table: table["within_mm"]["10"], True),
        ("-coverage", lambda table: table["coverage"], False),
        ("scale", lambda table: table["scale_median"], False),
    ],
)
def test_links_sort_without_javascript(board: Shared, sort: str, key: Any, falls: bool) -> None:
    rows = httpx2.get(f"{board.url}/api/v1/leaderboard?config=lattice").json()["rows"]
    values = [key(row["table"]) for row in rows]
    answer, parsed = page(f"{board.url}/?config=lattice&sort={sort}")
    ids = re.findall(r'<a href="/submissions/([^"]+)"><bdi>', answer.text)
    shown = [key(row["table"]) for one in ids for row in rows if row["id"] == one]
    assert shown == sorted(values, reverse=falls)
    sorted_heads = [head["aria-sort"] for head in parsed.named("th") if head.get("aria-sort")]
    assert sorted_heads == ["descending" if falls else "ascending"]


def test_a_sort_that_is_no_column_is_by_rank(board: Shared) -> None:
    odd = get(f"{board.url}/", params={"config": "lattice", "sort": "'; DROP TABLE"}).text
    assert names_in_order(odd) == names_in_order(get(f"{board.url}/?config=lattice").text)


def test_what_archives_say_is_only_text(board: Shared) -> None:
    for address in (f"{board.url}/", board.page("hostile")):
        answer, parsed = page(address)
        assert "<script>alert" not in answer.text
        assert "<b>second" not in answer.text
        assert HOSTILE in parsed.text
        assert "Müller & <Söhne>" in parsed.text
        assert not set(answer.text) & set("\u202e\x1b")
    links = [one for one in page(board.page("hostile"))[1].named("a") if "example.org" in str(one["href"])]
    assert [(one["href"], one["rel"]) for one in links] == [
        ("https://example.org/?a=1&b=<i>", "nofollow noopener noreferrer")
    ]


def test_a_scored_submission(board: Shared) -> None:
    answer, parsed = page(board.page("far"))
    rows = httpx2.get(f"{board.url}/api/v1/leaderboard?config=lattice").json()["rows"]
    rank = next(row["rank"] for row in rows if row["id"] == board.ids["far"])
    assert f"Scored : lattice rank {rank}." in parsed.text
    assert "http-equiv" not in answer.text
    assert f"/api/v1/submissions/{board.ids['far']}/result.json" in answer.text
    found = httpx2.get(f"{board.url}/api/v1/submissions/{board.ids['far']}/result.json").json()
    worst = max(found["views"], key=lambda view: view["native"]["abs_rel"])["view_id"]
    table = answer.text[answer.text.index("the worst 9 of 9 views") :]
    assert re.findall(r'class="name">(lattice/\d{4})<', table)[0] == worst
    maps = [one for one in parsed.named("img") if "error-maps" in str(one["src"])]
    assert len(maps) == 2
    picture = get(f"{board.url}{maps[0]['src']}")
    assert picture.headers["content-type"] == "image/webp"
    assert picture.content[8:12] == b"WEBP"


def test_all_views_are_listed_when_asked_for(board: Shared) -> None:
    _, parsed = page(board.page("good") + "?views=lattice-orbit")
    assert "lattice-orbit: all 2 views, worst first" in parsed.text


def test_a_submission_that_waits(waiting: Shared) -> None:
    answer, parsed = page(waiting.page("later"))
    assert re.search(r"number 2 of \d in the queue", parsed.text)
    assert re.search(r"number 1 of \d in the queue", page(waiting.page("next"))[1].text)
    assert "Not on the board" in parsed.text
    assert '<noscript><meta http-equiv="refresh" content="5"></noscript>' in answer.text
    assert answer.headers["cache-control"] == "no-store"


def test_a_submission_that_failed_says_why(waiting: Shared) -> None:
    _, parsed = page(waiting.page("failed"))
    assert "scoring took longer than the 0.01 s this service allows" in parsed.text


def test_what_is_not_public_is_not_on_the_board(waiting: Shared) -> None:
    answer, parsed = page(f"{waiting.url}/")
    assert "No submission of lattice is on the board yet." in parsed.text
    assert waiting.ids["scored"] not in answer.text
    assert "rank" not in page(waiting.page("scored"))[1].text.split("Submitted by")[0].replace("not ranked", "")
    picture = re.search(r'src="([^"]+error-maps[^"]+)"', get(waiting.page("scored")).text)
    assert picture is not None
    assert get(waiting.url + picture[1]).headers["cache-control"] == "no-store"


@pytest.mark.parametrize("path", ["/nope", "/submissions/nope", "/?config=nope", "/submissions/a%3Cb"])
def test_errors_are_pages_for_browsers_and_json_for_others(board: Shared, path: str) -> None:
    answer, _ = page(board.url + path)
    assert answer.status_code in (404, 422)
    plain = httpx2.get(board.url + path, headers={"Accept": "*/*"})
    assert plain.json()["detail"]
    assert httpx2.get(f"{board.url}/api/v1/submissions/nope", headers=BROWSER).json() == {
        "detail": "no such submission"
    }


@pytest.mark.parametrize("name", ["report.css", "page.css", "page.js", "sortable.js", "icon.svg"])
def test_static_files_are_kept_by_their_digest(board: Shared, name: str) -> None:
    address = re.search(rf'"(/static/{re.escape(name)}\?v=[0-9a-f]+)"', get(board.url).text)
    assert address is not None
    found = get(board.url + address[1])
    assert "immutable" in found.headers["cache-control"]
    again = get(board.url + address[1], headers={"If-None-Match": found.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    assert "immutable" not in get(f"{board.url}/static/{name}?v=0").headers["cache-control"]
    assert get(f"{board.url}/static/..%2F__init__.py").status_code == 404


def send(shared: Shared, archive: Path | None, token: str | None, first: bool = True) -> httpx2.Response:
    """Send the form as a browser does: fields in their order."""
    fields: list[tuple[str, Any]] = [] if token is None else [("token", (None, token))]
    if archive is not None:
        part = ("archive", (archive.name, archive.read_bytes(), "application/zip"))
        fields = [*fields, part] if first else [part, *fields]
    return httpx2.post(f"{shared.url}/submit", files=fields, headers=BROWSER, timeout=60)


def test_the_form_uploads_without_javascript(board: Shared, write_archive: Write) -> None:
    answer = send(board, write_archive("by form", 3.0), f" {board.token}\n")
    assert answer.status_code == 303
    address = answer.headers["location"]
    assert address.startswith("/submissions/")
    assert board.server.ended(address.rpartition("/")[2])["status"] == "scored"
    assert "by form" in names_in_order(get(board.url).text)


def test_the_form_refuses_as_the_api_does(waiting: Shared, write_archive: Write, tmp_path: Path) -> None:
    archive, broken, large = write_archive("x"), tmp_path / "broken.zip", tmp_path / "large.zip"
    with zipfile.ZipFile(broken, "w") as target:
        target.writestr("submission.json", json.dumps({"method": "x"}))
        target.writestr("lattice/<b>0000.npy", b"x")
    large.write_bytes(bytes(2_100_000))
    cases = [
        (send(waiting, archive, "rdb_wrong"), 401, "the token is unknown"),
        (send(waiting, archive, None), 401, "no token"),
        (send(waiting, archive, waiting.token, first=False), 401, "no token"),
        (send(waiting, archive, "x" * 5000), 401, "no token"),
        (send(waiting, broken, waiting.token), 422, "lattice/<b>0000.npy"),
        (send(waiting, None, waiting.token), 422, "has no field 'archive'"),
        (send(waiting, large, waiting.token), 413, "the most this service takes"),
    ]
    for answer, status, words in cases:
        assert answer.status_code == status, answer.text
        parsed = Page(answer.text)
        assert words in parsed.text
        assert "Not accepted" in parsed.text
        assert waiting.token not in answer.text
    by_api = waiting.server.submit(broken, waiting.token).json()["problems"]
    shown = Page(cases[4][0].text).text
    assert len(by_api) > 1
    assert all(" ".join(problem.split()) in shown for problem in by_api)
    assert not list((waiting.server.state / "spool").glob("*.upload"))


def test_a_body_that_is_no_form_is_refused(waiting: Shared) -> None:
    answer = httpx2.post(f"{waiting.url}/submit", content=b"hello", headers=BROWSER)
    assert answer.status_code == 422
    assert "expected multipart/form-data" in Page(answer.text).text


def test_how_to_submit_says_what_is_needed(waiting: Shared) -> None:
    _, parsed = page(f"{waiting.url}/how-to-submit")
    assert f"rebar-bench submit ARCHIVE --url {waiting.url}" in parsed.text
    assert "5 submissions a day" in parsed.text
    assert [field["name"] for field in parsed.named("input")] == ["token", "archive"]
    assert parsed.named("input")[0]["autocomplete"] == "off"
    assert parsed.named("form")[0]["enctype"] == "multipart/form-data"
