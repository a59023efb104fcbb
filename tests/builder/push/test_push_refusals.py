"""Pushes that are refused, fail, or meet a hostile Hub."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from huggingface_hub import constants
from starlette.requests import Request
from starlette.responses import JSONResponse, RedirectResponse, Response

from tests.builder.push.conftest import KEY, list_files, push, refused
from tests.hub_server import READ_TOKEN, TOKEN, HubServer, folder_files, running_hub

READING = ["GET */revision/main", "GET */tree/*"]
WRITING = [
    "POST /api/validate-yaml",
    "POST /api/repos/create",
    "POST */preupload/main",
    "POST */objects/batch",
    "POST */commit/main",
]


def test_commands_that_need_no_request_are_refused_without_one(hub: HubServer, root: Path) -> None:
    for hub_id in ("", "data", "a/b/c", "org/data@v1", "-org/x", "../data", "org/a--b"):
        refused(root, "--yes", hub_id=hub_id, words="--hub-id")
    for revision in ("", "../x", "a b", "-x", "\x1b[2J"):
        assert "\x1b" not in refused(root, "--yes", f"--revision={revision}", words="--revision")
    assert hub.requests == []


def test_missing_token_and_offline_mode_are_refused(
    hub: HubServer, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as without_token:
        without_token.delenv("HF_TOKEN")
        assert push(root).returncode == 0
        hub.requests.clear()
        no_token = push(root, "--yes")
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    for finished, name in ((no_token, "HF_TOKEN"), (push(root, "--yes"), "HF_HUB_OFFLINE")):
        assert finished.returncode == 2
        assert name in finished.stderr
    assert hub.requests == []


@pytest.mark.parametrize(("token", "status"), [(f"{TOKEN}x", 401), (READ_TOKEN, 403)])
def test_token_that_the_hub_does_not_accept(
    hub: HubServer, root: Path, monkeypatch: pytest.MonkeyPatch, token: str, status: int
) -> None:
    monkeypatch.setenv("HF_TOKEN", token)
    assert token not in refused(root, "--yes", words=f"status {status}")
    assert hub.repositories == {}


def test_unreachable_hub_is_named_with_status_1(
    root: Path, hub: HubServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    refused(root, words="http://127.0.0.1:9", status=1)


@pytest.mark.parametrize("content", ["<html>", "null", "{}", '[{"type": "file"}]'])
@pytest.mark.parametrize("request_pattern", [*READING, *WRITING])
def test_answers_that_are_not_those_of_a_hub(
    hub: HubServer, root: Path, request_pattern: str, content: str
) -> None:
    hub.add(KEY)
    if request_pattern == "POST /api/repos/create":
        del hub.repositories[KEY]
    hub.faults[request_pattern] = lambda _: Response(content, media_type="application/json")
    finished = push(root, "--yes")
    may_succeed = request_pattern == "POST /api/validate-yaml" or (request_pattern, content) == (READING[1], "{}")
    if finished.returncode == 0:
        assert may_succeed
    else:
        assert finished.returncode in (1, 2)
        assert "error: " in finished.stderr
        assert all(set(one.files()) <= {".gitattributes"} for one in hub.repositories.values())


@pytest.mark.parametrize("status", [400, 409, 500, 507])
@pytest.mark.parametrize("request_pattern", [READING[0], "POST /api/repos/create", "POST */commit/main"])
def test_refusal_of_the_hub_is_reported_with_its_status(
    hub: HubServer, root: Path, request_pattern: str, status: int
) -> None:
    message = "Storage quota of org is used up \x1b[2J"
    answer = JSONResponse({"error": f"{message} {TOKEN}"}, status)
    hub.faults[request_pattern] = lambda _: answer
    finished = push(root, "--yes")
    if request_pattern == "POST /api/repos/create" and status == 409:
        # The repository exists, says the Hub, without the address that it then gives.
        assert finished.returncode == 1
        return
    assert finished.returncode == (2 if status == 400 else 1)
    assert f"status {status}: " in finished.stderr
    assert "Storage quota of org" in finished.stderr
    assert "\x1b" not in finished.stderr


def redirect(url: str, status: int, request: Request) -> Response:
    return RedirectResponse(f"{url}{request.scope['path']}", status)


@pytest.mark.parametrize("request_pattern", [*READING, "POST /api/repos/create", "POST */commit/main"])
def test_redirects_to_another_server_do_not_take_the_token_along(
    hub: HubServer, root: Path, request_pattern: str
) -> None:
    if request_pattern != "POST /api/repos/create":
        hub.add(KEY)
    with running_hub() as elsewhere:
        elsewhere.faults["*"] = lambda _: JSONResponse({"error": "mine"})
        for status in (302, 307):
            hub.faults[request_pattern] = partial(redirect, elsewhere.url, status)
            finished = push(root, "--yes")
            assert finished.returncode in (1, 2)
            assert "error: " in finished.stderr
        assert elsewhere.requests
        assert all(one.authorization == "" for one in elsewhere.requests)


def test_card_that_the_hub_refuses(hub: HubServer, root: Path) -> None:
    card = root / "README.md"
    card.write_text(card.read_text().replace("license: cc-by-4.0\n", ""))
    refused(list_files(root), "--yes", words=r"\"license\" is required")
    assert hub.repositories == {}


def test_public_repository_and_one_with_other_content_are_refused(hub: HubServer, root: Path) -> None:
    hub.add(KEY)
    refused(root, "--yes", "--private", words="public")
    files = {"model.safetensors": b"weights", "README.md": b"mine"}
    repository = hub.add(KEY, files)
    for options in ([], ["--yes"]):
        refused(root, *options, words="manifest.json")
    assert hub.written() == []
    del repository.commits[repository.branches["main"]]
    repository.commit("main", {"README.md": b"made by the web page"})
    assert push(root, "--yes").returncode == 0


def test_commit_of_someone_else_in_between_is_not_overwritten(hub: HubServer, root: Path) -> None:
    repository = hub.add(KEY)
    theirs = {"manifest.json": b"theirs"}

    def commit_theirs(_: Request) -> None:
        if repository.files() != theirs:
            repository.commit("main", theirs)

    hub.faults["PUT *"] = commit_theirs
    refused(root, "--yes", words="status 412", status=1)
    assert repository.files() == theirs


def rewrite(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1] + b"x")


@pytest.mark.parametrize(
    ("name", "change", "status"),
    [
        ("manifest.json", rewrite, 2),
        ("README.md", rewrite, 2),
        ("lattice/test.parquet", rewrite, 2),
        ("lattice/test.parquet", Path.unlink, 1),
    ],
)
def test_file_that_changes_during_the_upload_is_not_published(
    hub: HubServer, root: Path, name: str, change: Callable[[Path], None], status: int
) -> None:
    hub.faults["POST */preupload/main"] = lambda _: change(root / name)
    refused(root, "--yes", words=name, status=status)
    assert set(hub.repositories[KEY].files()) == {".gitattributes"}


def test_upload_whose_content_the_hub_finds_damaged(hub: HubServer, root: Path) -> None:
    hub.faults["PUT *"] = lambda _: JSONResponse({"error": "checksum mismatch"}, 400)
    refused(root, "--yes", words="checksum mismatch")
    assert set(hub.repositories[KEY].files()) == {".gitattributes"}


def test_names_of_files_on_the_hub_are_shown_without_control_characters(hub: HubServer, root: Path) -> None:
    hub.add(KEY, {"manifest.json": b"{}", "a\x1b[2J": b""})
    finished = push(root)
    assert finished.returncode == 0
    assert "deleted  a" in finished.stdout
    assert "\x1b" not in finished.stdout


def test_warnings_of_the_hub_are_shown_as_plain_text(hub: HubServer, root: Path) -> None:
    warning = json.dumps({"errors": [], "warnings": [{"message": f"empty metadata\x1b[2J {TOKEN}"}]})
    hub.faults["POST /api/validate-yaml"] = lambda _: Response(warning)
    finished = push(root, "--yes")
    assert finished.returncode == 0
    assert "empty metadata" in finished.stderr
    assert "\x1b" not in finished.stderr
    assert folder_files(root).items() <= hub.repositories[KEY].files().items()
