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


EXPECTED = {
    *(("POST", status) for status in ("202", "422")),
    *(("PUT", status) for status in ("200", "422")),
    *(("GET", status) for status in ("200", "404", "422")),
    *(("PATCH", status) for status in ("200", "404", "422")),
    *(("DELETE", status) for status in ("204", "404")),
}
"""Responses that must occur; otherwise the requests did not reach the code under test."""


def test_responses_match_openapi_document(
    server: Server, token: str, small_archive: Path, tmp_path: Path, repetitions: Repetitions
) -> None:
    hooks = tmp_path / "hooks.py"
    hooks.write_text(UPLOAD_HOOKS.format(archive=str(small_archive)))
    command = [sys.executable, "-m", "schemathesis.cli", "run", f"{server.url}/openapi.json", "--no-color"]
    command += ["--checks", "all", "--exclude-checks", ",".join(EXCLUDED_CHECKS), "--continue-on-failure"]
    command += ["--generation-deterministic", "--max-examples", str(repetitions(4, 30))]
    command += ["--header", f"Authorization: Bearer {token}"]
    environment = {**os.environ, "SCHEMATHESIS_HOOKS": str(hooks)}
    process = subprocess.run(
        command, capture_output=True, text=True, cwd=tmp_path, check=False, timeout=1800, env=environment
    )
    assert process.returncode == 0, process.stdout + process.stderr
    assert re.search(r"Operations: +12 selected / 12 total", process.stdout)
    events = [json.loads(line) for line in server.log if line.startswith("{")]
    requests = [event for event in events if event["event"] == "request" and event["route"].startswith("/api/")]
    responses = {(event["method"], str(event["status"])) for event in requests}
    assert responses >= EXPECTED
    assert not any(status >= "500" for _, status in responses)


@pytest.mark.parametrize("header", [None, "Bearer nobody's", "Bearer \udcff"])
def test_requests_without_a_known_token_are_401_as_documented(
    server: Server, document: dict[str, Any], header: str | None
) -> None:
    headers = {} if header is None else {"Authorization": header.encode("utf-8", "surrogateescape")}
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            address = f"{path.replace('{submission_id}', 'some')}?config=lattice"
            response = server.call(method.upper(), address, headers=headers)
            needs_token = {"HTTPBearer": []} in operation.get("security", []) and {} not in operation["security"]
            if needs_token or (header and operation.get("security")):
                assert (response.status_code, list(response.json())) == (401, ["detail"]), (method, path)
                assert response.headers["www-authenticate"] == "Bearer"
                assert "401" in operation["responses"]
            else:
                assert response.status_code != 401, (method, path)
            assert str(response.status_code) in operation["responses"], (method, path)


@pytest.mark.parametrize(("path", "allowed"), [(f"{API}/some", "DELETE, GET, PATCH"), ("/how-to-submit", "GET")])
def test_unsupported_method_is_405_with_allow_header(server: Server, path: str, allowed: str) -> None:
    response = server.call("PUT", path)
    assert (response.status_code, response.headers["allow"]) == (405, allowed)
