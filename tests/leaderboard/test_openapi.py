"""OpenAPI document checked against a real server with the command line of schemathesis.

Valid and invalid requests generated from the document get the statuses, types and schemas that it states.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.leaderboard.serving import API, RunServer, Server
from tests.requirements import Repetitions

EXCLUDED_CHECKS = (
    # The document allows any bytes as an archive; the service rejects most of them.
    "positive_data_acceptance",
    # The result of a submission is available once it is scored, not once it is accepted.
    "ensure_resource_availability",
)
UPLOAD_HOOKS = """
import schemathesis
from hypothesis import strategies as st
from pathlib import Path

sound = Path({archive!r}).read_bytes()
schemathesis.openapi.media_type("application/zip", st.sampled_from([sound, sound[:-9], b"PK", b""]))


@schemathesis.serializer("application/zip")
def as_is(context, value):
    return value if isinstance(value, bytes) else str(value).encode(errors="replace")


schemathesis.openapi.format("binary", st.sampled_from([sound, sound[:-9], sound[9:], b"PK", b""]))
"""
"""Hooks with valid archives; without them no upload would be accepted, and nothing read, published or deleted."""


@pytest.fixture(scope="module")
def server(running_server: RunServer) -> Iterator[Server]:
    with running_server(quota=1_000_000, max_upload=1_000_000, default_visibility="owner") as started:
        yield started


@pytest.fixture(scope="module")
def document(server: Server) -> dict[str, Any]:
    return dict(server.get("/openapi.json").json())


@pytest.fixture(scope="module")
def token(server: Server) -> str:
    return server.token("schemathesis")


def api_responses(log: list[str]) -> set[tuple[str, str]]:
    """Return method and status of the responses of the API that log lines tell of."""
    events = [json.loads(line) for line in log if line.startswith("{")]
    return {
        (event["method"], str(event["status"]))
        for event in events
        if event["event"] == "request" and event["route"].startswith("/api/")
    }


def fuzz(server: Server, hooks: Path, token: str, max_examples: int) -> str:
    """Run ``schemathesis run`` and return its output; fail if it reports a problem."""
    command = [sys.executable, "-m", "schemathesis.cli", "run", f"{server.url}/openapi.json", "--no-color"]
    command += ["--checks", "all", "--exclude-checks", ",".join(EXCLUDED_CHECKS), "--continue-on-failure"]
    command += ["--generation-deterministic", "--max-examples", str(max_examples)]
    command += ["--header", f"Authorization: Bearer {token}"]
    process = subprocess.run(
        command,
        capture_output=True,
        text=True,
        cwd=hooks.parent,
        check=False,
        timeout=1800,
        env={**os.environ, "SCHEMATHESIS_HOOKS": str(hooks)},
    )
    assert process.returncode == 0, process.stdout + process.stderr
    return process.stdout


EXPECTED = {
    *(("POST", status) for status in ("202", "422")),
    *(("PUT", status) for status in ("200", "422")),
    *(("GET", status) for status in ("200", "404", "422")),
    *(("PATCH", status) for status in ("200", "404", "422")),
    *(("DELETE", status) for status in ("204", "404", "422")),
}
"""Responses that must occur; otherwise the requests did not reach the code under test."""


def test_responses_match_openapi_document(
    server: Server, token: str, small_archive: Path, tmp_path: Path, repetitions: Repetitions
) -> None:
    hooks = tmp_path / "hooks.py"
    hooks.write_text(UPLOAD_HOOKS.format(archive=str(small_archive)))
    output = fuzz(server, hooks, token, repetitions(4, 30))
    assert re.search(r"Operations: +12 selected / 12 total", output)
    responses = api_responses(server.log)
    assert responses >= EXPECTED
    assert not any(status >= "500" for _, status in responses)


@pytest.mark.parametrize("header", [None, "Bearer nobody's"])
def test_requests_without_a_known_token_are_401_as_documented(
    server: Server, document: dict[str, Any], header: str | None
) -> None:
    headers = {} if header is None else {"Authorization": header}
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            address = f"{path.replace('{submission_id}', 'some')}?config=lattice"
            response = server.call(method.upper(), address, headers=headers)
            needs_token = {"HTTPBearer": []} in operation.get("security", []) and {} not in operation["security"]
            if needs_token or (header and operation.get("security")):
                assert (response.status_code, list(response.json())) == (401, ["detail"]), (method, path)
                assert "401" in operation["responses"]
            else:
                assert response.status_code != 401, (method, path)
            assert str(response.status_code) in operation["responses"], (method, path)


@pytest.mark.parametrize(
    ("body", "status"),
    [(b"\xc3", 400), (b"", 422), (b"{", 422), (b'{"public": 1}', 422), (b'{"public": true, "id": "x"}', 422)],
)
def test_invalid_patch_is_rejected_as_documented(
    server: Server, document: dict[str, Any], token: str, body: bytes, status: int
) -> None:
    headers = {"Content-Type": "application/json"}
    response = server.call("PATCH", f"{API}/some", token, content=body, headers=headers)
    assert response.status_code == status
    documented = document["paths"]["/api/v1/submissions/{submission_id}"]["patch"]["responses"][str(status)]
    model = documented["content"]["application/json"]["schema"]["$ref"].split("/")[-1]
    assert set(response.json()) == set(document["components"]["schemas"][model]["required"])


def test_models_have_examples_and_operations_descriptions(document: dict[str, Any]) -> None:
    for name in ("ErrorResponse", "RejectedResponse", "Submission", "SubmissionChange"):
        assert document["components"]["schemas"][name]["example"]
    operations = [operation for path in document["paths"].values() for operation in path.values()]
    assert all(operation["description"] for operation in operations)
    assert all(response["description"] for operation in operations for response in operation["responses"].values())


def test_page_of_submitters_lists_every_request(document: dict[str, Any]) -> None:
    served = {
        f"{method.upper()} {path.replace('{submission_id}', 'ID')}"
        for path, operations in document["paths"].items()
        for method in operations
    }
    page = (Path(__file__).parents[2] / "docs/leaderboard-submitter.md").read_text()
    listed = re.findall(r"^\| `([A-Z]+ [^`?]+)", page, re.MULTILINE)
    assert {*listed, "GET /api/v1/leaderboard.csv"} == served
    assert "`leaderboard.csv`" in page


@pytest.mark.parametrize(("path", "allowed"), [(f"{API}/some", "DELETE, GET, PATCH"), ("/how-to-submit", "GET")])
def test_unsupported_method_is_405_with_allow_header(server: Server, path: str, allowed: str) -> None:
    response = server.call("PUT", path)
    assert (response.status_code, response.headers["allow"]) == (405, allowed)
