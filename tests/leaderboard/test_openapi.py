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

import httpx2
import pytest

from tests.leaderboard.conftest import WriteArchive
from tests.leaderboard.serving import RunServer, Server
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
def server(tmp_path_factory: pytest.TempPathFactory, running_server: RunServer) -> Iterator[Server]:
    state = tmp_path_factory.mktemp("openapi") / "state"
    often = "1000000/minute"
    with running_server(
        state,
        read_rate_limit=often,
        write_rate_limit=often,
        quota=1_000_000,
        max_upload=1_000_000,
        default_visibility="owner",
    ) as started:
        yield started


@pytest.fixture(scope="module")
def tokens(server: Server) -> dict[str, str]:
    return {"token": server.token("schemathesis"), "unknown token": "nobody's"}


@pytest.fixture(scope="module")
def hooks(write_archive: WriteArchive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("hooks") / "hooks.py"
    path.write_text(UPLOAD_HOOKS.format(archive=str(write_archive("fuzzed", configs=("lattice-orbit",)))))
    return path


def api_responses(log: list[str]) -> set[tuple[str, str]]:
    """Return method and status of the responses of the API that log lines tell of."""
    events = [json.loads(line) for line in log if line.startswith("{")]
    return {
        (event["method"], str(event["status"]))
        for event in events
        if event["event"] == "request" and event["route"].startswith("/api/")
    }


def fuzz(server: Server, hooks: Path, folder: Path, token: str | None, max_examples: int, *phases: str) -> str:
    """Run ``schemathesis run`` and return its output; fail if it reports a problem."""
    command = [sys.executable, "-m", "schemathesis.cli", "run", f"{server.url}/openapi.json", "--no-color"]
    command += ["--checks", "all", "--exclude-checks", ",".join(EXCLUDED_CHECKS), "--continue-on-failure"]
    command += ["--generation-deterministic", "--max-examples", str(max_examples), "--phases", ",".join(phases)]
    command += [] if token is None else ["--header", f"Authorization: Bearer {token}"]
    environment = {**os.environ, "SCHEMATHESIS_HOOKS": str(hooks)}
    process = subprocess.run(
        command, capture_output=True, text=True, cwd=folder, check=False, timeout=1800, env=environment
    )
    assert process.returncode == 0, process.stdout + process.stderr
    return process.stdout


ALL_PHASES = ("examples", "coverage", "fuzzing", "stateful")
EXPECTED = {
    "token": {
        *(("POST", status) for status in ("202", "422")),
        *(("PUT", status) for status in ("200", "422")),
        *(("GET", status) for status in ("200", "404", "422")),
        *(("PATCH", status) for status in ("200", "404", "422")),
        *(("DELETE", status) for status in ("204", "404", "422")),
    },
    "unknown token": {(method, "401") for method in ("POST", "GET", "PATCH", "DELETE")},
    "nobody": {(method, "401") for method in ("POST", "PATCH", "DELETE")} | {("GET", "200"), ("GET", "404")},
}
"""Responses that must occur; otherwise the requests did not reach the code under test."""


@pytest.mark.parametrize("who", EXPECTED)
def test_responses_match_openapi_document(
    server: Server, tokens: dict[str, str], hooks: Path, tmp_path: Path, who: str, repetitions: Repetitions
) -> None:
    num_lines_before = len(server.log)
    # Without a token no submission exists for stateful tests.
    phases = ALL_PHASES if who == "token" else ("coverage",)
    output = fuzz(server, hooks, tmp_path, tokens.get(who), repetitions(4, 30), *phases)
    assert re.search(r"Operations: +12 selected / 12 total", output)
    new_responses = api_responses(server.log[num_lines_before:])
    assert new_responses >= EXPECTED[who]
    assert not any(status >= "500" for _, status in new_responses)


@pytest.mark.parametrize(
    ("body", "status"),
    [(b"\xc3", 400), (b"", 422), (b"{", 422), (b'{"public": 1}', 422), (b'{"public": true, "id": "x"}', 422)],
)
def test_invalid_patch_is_rejected_as_documented(
    server: Server, tokens: dict[str, str], body: bytes, status: int
) -> None:
    headers = {"Authorization": f"Bearer {tokens['token']}", "Content-Type": "application/json"}
    response = httpx2.patch(f"{server.url}/api/v1/submissions/some", content=body, headers=headers)
    assert response.status_code == status
    document = httpx2.get(f"{server.url}/openapi.json").json()
    documented = document["paths"]["/api/v1/submissions/{submission_id}"]["patch"]["responses"][str(status)]
    model = documented["content"]["application/json"]["schema"]["$ref"].split("/")[-1]
    assert set(response.json()) == set(document["components"]["schemas"][model]["required"])


def test_models_have_examples_and_operations_descriptions(server: Server) -> None:
    document: dict[str, Any] = httpx2.get(f"{server.url}/openapi.json").json()
    for name in ("ErrorResponse", "RejectedResponse", "Submission", "SubmissionChange"):
        assert document["components"]["schemas"][name]["example"]
    operations = [operation for path in document["paths"].values() for operation in path.values()]
    assert all(operation["description"] for operation in operations)
    assert all(response["description"] for operation in operations for response in operation["responses"].values())


def test_unsupported_method_is_405_with_allow_header(server: Server) -> None:
    response = httpx2.put(f"{server.url}/api/v1/submissions/some")
    assert (response.status_code, response.headers["allow"]) == (405, "DELETE, GET, PATCH")
    response = httpx2.put(f"{server.url}/how-to-submit")
    assert (response.status_code, response.headers["allow"]) == (405, "GET")
