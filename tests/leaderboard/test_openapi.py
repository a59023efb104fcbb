"""The OpenAPI document, held against a real server by schemathesis' own command.

Requests made from the document, right and wrong ones, are answered with the statuses, types and schemas it tells.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2
import pytest

from tests.leaderboard.conftest import Write
from tests.leaderboard.serving import Server, running_server

LEFT_OUT = (
    # To the document an archive is any bytes: that most are refused is the service's business.
    "positive_data_acceptance",
    # The result of a submission comes when it is scored, not when it is accepted.
    "ensure_resource_availability",
)
UPLOADS = """
import schemathesis
from hypothesis import strategies as st
from pathlib import Path

sound = Path({archive!r}).read_bytes()
schemathesis.openapi.format("binary", st.sampled_from([sound, sound[:-9], sound[9:], b"PK", b""]))
"""
"""Without this no upload would ever be accepted, and nothing found, published or deleted."""


@pytest.fixture(scope="module")
def server(tiny_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    state = tmp_path_factory.mktemp("openapi") / "state"
    often = "1000000/minute"
    with running_server(
        tiny_root, state, reads=often, writes=often, quota=1_000_000, max_upload=1_000_000, public="owner"
    ) as started:
        yield started


@pytest.fixture(scope="module")
def tokens(server: Server) -> dict[str, str]:
    return {"token": server.token("schemathesis"), "unknown token": "nobody's"}


@pytest.fixture(scope="module")
def hooks(write_archive: Write, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("hooks") / "hooks.py"
    path.write_text(UPLOADS.format(archive=str(write_archive("fuzzed", configs=("lattice-orbit",)))))
    return path


def answered(server: Server) -> dict[tuple[str, str, str], float]:
    """Return how often each method, route and status was answered, as the server counts them."""
    lines = re.findall(
        r'rebar_requests_total\{method="(.+?)",route="(.+?)",status="(\d+)"\} (\S+)',
        httpx2.get(f"{server.url}/metrics").text,
    )
    return {(method, route, status): float(count) for method, route, status, count in lines}


def fuzz(server: Server, hooks: Path, folder: Path, token: str | None, *phases: str) -> str:
    """Run ``schemathesis run`` and return what it tells; fails where it finds something."""
    command = [sys.executable, "-m", "schemathesis.cli", "run", f"{server.url}/openapi.json", "--no-color"]
    command += ["--checks", "all", "--exclude-checks", ",".join(LEFT_OUT), "--continue-on-failure"]
    command += ["--generation-deterministic", "--max-examples", "8", "--phases", ",".join(phases)]
    command += [] if token is None else ["--header", f"Authorization: Bearer {token}"]
    environment = {**os.environ, "SCHEMATHESIS_HOOKS": str(hooks)}
    told = subprocess.run(
        command, capture_output=True, text=True, cwd=folder, check=False, timeout=300, env=environment
    )
    assert told.returncode == 0, told.stdout + told.stderr
    return told.stdout


ALL_PHASES = ("examples", "coverage", "fuzzing", "stateful")
EXPECTED = {
    "token": {
        *(("POST", status) for status in ("202", "422")),
        *(("GET", status) for status in ("200", "404", "422")),
        *(("PATCH", status) for status in ("200", "404", "422")),
        *(("DELETE", status) for status in ("204", "404", "422")),
    },
    "unknown token": {(method, "401") for method in ("POST", "GET", "PATCH", "DELETE")},
    "nobody": {(method, "401") for method in ("POST", "PATCH", "DELETE")} | {("GET", "200"), ("GET", "404")},
}
"""Answers that must have come: else the requests never got to what they are to try."""


@pytest.mark.parametrize("who", EXPECTED)
def test_what_the_document_allows_and_forbids_is_answered_as_it_says(
    server: Server, tokens: dict[str, str], hooks: Path, tmp_path: Path, who: str
) -> None:
    before = answered(server)
    phases = ALL_PHASES if who == "token" else ("coverage",)  # without one nothing comes to be, to be followed up
    told = fuzz(server, hooks, tmp_path, tokens.get(who), *phases)
    assert re.search(r"Operations: +9 selected / 9 total", told)
    found = {
        (method, status)
        for (method, route, status), count in answered(server).items()
        if count > before.get((method, route, status), 0) and route.startswith("/api/")
    }
    assert found >= EXPECTED[who]
    assert not any(status >= "500" for _, status in found)


@pytest.mark.parametrize(
    ("body", "status"),
    [(b"\xc3", 400), (b"", 422), (b"{", 422), (b'{"public": 1}', 422), (b'{"public": true, "id": "x"}', 422)],
)
def test_a_change_in_no_words_we_know_is_refused_as_documented(
    server: Server, tokens: dict[str, str], body: bytes, status: int
) -> None:
    headers = {"Authorization": f"Bearer {tokens['token']}", "Content-Type": "application/json"}
    answer = httpx2.patch(f"{server.url}/api/v1/submissions/some", content=body, headers=headers)
    assert answer.status_code == status
    document = httpx2.get(f"{server.url}/openapi.json").json()
    told = document["paths"]["/api/v1/submissions/{submission_id}"]["patch"]["responses"][str(status)]
    model = told["content"]["application/json"]["schema"]["$ref"].split("/")[-1]
    assert set(answer.json()) == set(document["components"]["schemas"][model]["required"])


def test_every_model_has_an_example_and_every_operation_words(server: Server) -> None:
    document: dict[str, Any] = httpx2.get(f"{server.url}/openapi.json").json()
    for name in ("Problem", "Problems", "Submission", "Publication"):
        assert document["components"]["schemas"][name]["example"]
    operations = [one for path in document["paths"].values() for one in path.values()]
    assert all(one["description"] for one in operations)
    assert all(answer["description"] for one in operations for answer in one["responses"].values())


def test_a_method_that_a_path_does_not_take_is_told_those_it_takes(server: Server) -> None:
    answer = httpx2.put(f"{server.url}/api/v1/submissions/some")
    assert (answer.status_code, answer.headers["allow"]) == (405, "DELETE, GET, PATCH")
    answer = httpx2.put(f"{server.url}/how-to-submit")
    assert (answer.status_code, answer.headers["allow"]) == (405, "GET")
