"""A Hugging Face Hub on this machine: repositories with branches and commits, git LFS, and faults on request.

It implements the endpoints that ``huggingface_hub`` uses to read and write repositories without Xet. Files with
the suffixes ``LFS_SUFFIXES`` are stored by SHA-256, which is verified; the others are part of commits. Every
request is recorded.
"""

from __future__ import annotations

import base64
import fnmatch
import hashlib
import json
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import uvicorn
from huggingface_hub.utils.sha import git_hash
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

TOKEN = "hf_localServerTokenWithPermissionToWrite"
READ_TOKEN = "hf_localServerTokenWithoutPermission"
LFS_SUFFIXES = (".parquet", ".ply", ".webp")
GITATTRIBUTES = b"*.parquet filter=lfs diff=lfs merge=lfs -text\n"
Files = Mapping[str, bytes]


@dataclass
class StoredRepository:
    """Repository with the files of its commits, by path, and the commit of each branch."""

    private: bool = False
    commits: dict[str, Files] = field(default_factory=dict)
    branches: dict[str, str] = field(default_factory=dict)

    def commit(self, branch: str, files: Files, title: str = "") -> str:
        """Add a commit to a branch and return its id."""
        parent = self.branches.get(branch, "")
        digests = {path: hashlib.sha256(content).hexdigest() for path, content in sorted(files.items())}
        commit = hashlib.sha1(json.dumps([parent, branch, title, digests]).encode()).hexdigest()
        self.commits[commit], self.branches[branch] = dict(files), commit
        return commit

    def files(self, branch: str = "main") -> Files:
        """Return the files of a branch."""
        return self.commits[self.branches[branch]]


@dataclass(frozen=True)
class Received:
    """Request that the server received."""

    method: str
    path: str
    authorization: str


class RefusedError(Exception):
    """Request that the Hub refuses, with status, error code and message."""

    def __init__(self, status: int, code: str = "", message: str = "") -> None:
        self.response = JSONResponse(
            {"error": message}, status, {"X-Error-Code": code, "X-Error-Message": message}
        )


class HubServer:
    """Repositories by kind and id (``datasets/org/name``), LFS objects by SHA-256, requests and faults."""

    def __init__(self) -> None:
        self.repositories: dict[str, StoredRepository] = {}
        self.objects: dict[str, bytes] = {}
        self.requests: list[Received] = []
        self.faults: dict[str, Callable[[Request], Response | None]] = {}
        """Answers in place of the Hub's, by a pattern of the method and path; None lets the Hub answer."""
        self.url = ""

    def add(self, key: str, files: Files = {}, *, private: bool = False) -> StoredRepository:  # noqa: B006
        """Add a repository with a first commit, as the Hub does."""
        repository = self.repositories[key] = StoredRepository(private)
        repository.commit("main", {".gitattributes": GITATTRIBUTES, **files}, "initial commit")
        return repository

    def written(self) -> list[str]:
        """Return the requests that write, or could write, as method and path."""
        return [f"{one.method} {one.path}" for one in self.requests if one.method not in ("GET", "HEAD")]

    def uploads(self) -> list[str]:
        """Return the SHA-256 of the objects that were uploaded, in order."""
        return [one.path.rpartition("/")[2] for one in self.requests if one.method == "PUT"]

    async def answer(self, request: Request) -> Response:
        """Return the answer to any request."""
        method, path = request.method, request.scope["path"]
        self.requests.append(Received(method, path, request.headers.get("authorization", "")))
        for pattern, fault in list(self.faults.items()):
            if fnmatch.fnmatchcase(f"{method} {path}", pattern):
                await request.body()
                if (response := fault(request)) is not None:
                    return response
        try:
            return await self._route(request, method, path)
        except RefusedError as error:
            return error.response

    async def _route(self, request: Request, method: str, path: str) -> Response:
        token = request.headers.get("authorization", "").removeprefix("Bearer ")
        if path.startswith("/lfs/"):
            return await self._lfs_object(request, method, path)
        if token not in ("", TOKEN, READ_TOKEN):
            raise RefusedError(401, "", "Invalid credentials in Authorization header")
        if path == "/api/validate-yaml":
            return self._validate_yaml(await request.json())
        if path == "/api/whoami-v2":
            return JSONResponse({"type": "user", "name": "org"})
        if method == "POST" and token != TOKEN:
            raise RefusedError(403, "", "This token has no permission to write")
        if path == "/api/repos/create":
            return self._create(await request.json())
        if path.endswith(".git/info/lfs/objects/batch"):
            return self._lfs_batch(await request.json())
        key, _, rest = self._split(path)
        repository = self.repositories.get(key)
        if repository is None or (repository.private and token != TOKEN):
            raise RefusedError(404, "RepoNotFound", "Repository not found")
        action, _, argument = rest.partition("/")
        handlers = {
            "": self._revision,
            "revision": self._revision,
            "tree": self._tree,
            "resolve": self._resolve,
            "branch": self._branch,
            "preupload": self._preupload,
            "commit": self._commit,
        }
        if action not in handlers:
            raise RefusedError(404, "", "Not found")
        return await handlers[action](request, key, repository, argument)

    @staticmethod
    def _split(path: str) -> tuple[str, str, str]:
        """Return repository, separator and the rest of a path such as ``/api/datasets/org/name/tree/main``."""
        parts = path.removeprefix("/api").strip("/").split("/")
        if parts[0] not in ("datasets", "models"):
            parts = ["models", *parts]
        return "/".join(parts[:3]), "/", "/".join(parts[3:])

    @staticmethod
    def _at(repository: StoredRepository, argument: str) -> tuple[str, str]:
        """Return the commit of the revision that ``argument`` starts with, and the path after it."""
        revisions = {**repository.branches, **{commit: commit for commit in repository.commits}}
        for revision, commit in revisions.items():
            if argument == revision or argument.startswith(f"{revision}/"):
                return commit, argument.removeprefix(revision).strip("/")
        raise RefusedError(404, "RevisionNotFound", "Invalid revision")

    async def _revision(self, _: Request, key: str, repository: StoredRepository, argument: str) -> Response:
        commit, _path = self._at(repository, argument or "main")
        siblings = [{"rfilename": name, "size": len(data)} for name, data in repository.commits[commit].items()]
        name = key.partition("/")[2]
        return JSONResponse({"id": name, "sha": commit, "private": repository.private, "siblings": siblings})

    async def _tree(self, request: Request, _: str, repository: StoredRepository, argument: str) -> Response:
        commit, folder = self._at(repository, argument)
        files = repository.commits[commit]
        inside = {name: content for name, content in files.items() if name.startswith(f"{folder}/"[not folder :])}
        folders = list[dict[str, Any]]()
        if request.query_params.get("recursive", "").lower() != "true":
            prefix = f"{folder}/" if folder else ""
            parts = {name: name.removeprefix(prefix).partition("/") for name in inside}
            names = {f"{prefix}{first}" for first, separator, _ in parts.values() if separator}
            folders = [{"type": "directory", "path": name, "oid": git_hash(b"")} for name in sorted(names)]
            inside = {name: content for name, content in inside.items() if not parts[name][1]}
        return JSONResponse([*folders, *(_entry(name, content) for name, content in inside.items())])

    async def _resolve(self, request: Request, _: str, repository: StoredRepository, argument: str) -> Response:
        commit, name = self._at(repository, argument)
        if name not in repository.commits[commit]:
            raise RefusedError(404, "EntryNotFound", "Entry not found")
        content = repository.commits[commit][name]
        etag = _oid(name, content)
        headers = {"ETag": f'"{etag}"', "X-Repo-Commit": commit, "Accept-Ranges": "bytes"}
        first, _dash, last = request.headers.get("range", "").removeprefix("bytes=").partition("-")
        if first and request.method == "GET":
            part = content[int(first) : int(last) + 1 if last else None]
            headers["Content-Range"] = f"bytes {first}-{int(first) + len(part) - 1}/{len(content)}"
            return Response(part, 206, headers)
        return Response(content, 200, headers)

    def _create(self, body: Mapping[str, Any]) -> Response:
        key = f"{body['type']}s/{body['organization']}/{body['name']}"
        if key in self.repositories:
            raise RefusedError(409, "", "You already created this dataset repo")
        self.add(key, private=body.get("private") or body.get("visibility") == "private")
        return JSONResponse({"url": f"{self.url}/{key}"})

    async def _branch(self, request: Request, _: str, repository: StoredRepository, argument: str) -> Response:
        commit, _path = self._at(repository, (await request.json()).get("startingPoint", "main"))
        repository.branches[argument] = commit
        return Response(status_code=201)

    @staticmethod
    def _validate_yaml(body: Mapping[str, Any]) -> Response:
        if "license:" in body["content"]:
            return JSONResponse({"errors": [], "warnings": []})
        return JSONResponse({"errors": [{"message": '"license" is required'}], "warnings": []}, 400)

    async def _preupload(self, request: Request, _: str, repository: StoredRepository, argument: str) -> Response:
        commit, _path = self._at(repository, argument)
        body, files = await request.json(), repository.commits[commit]
        rules = body.get("gitIgnore", files.get(".gitignore", b"").decode()).splitlines()
        modes = [
            {
                "path": (name := entry["path"]),
                "uploadMode": "lfs" if name.endswith(LFS_SUFFIXES) else "regular",
                "shouldIgnore": any(fnmatch.fnmatch(name, rule) for rule in rules if not rule.startswith("#")),
                "oid": _oid(name, files[name]) if name in files else None,
            }
            for entry in body["files"]
        ]
        return JSONResponse({"files": modes})

    def _lfs_batch(self, body: Mapping[str, Any]) -> Response:
        objects = []
        for wanted in body["objects"]:
            upload = {"upload": {"href": f"{self.url}/lfs/{wanted['oid']}"}}
            verify = {"verify": {"href": f"{self.url}/lfs/verify"}}
            objects.append({**wanted, **({} if wanted["oid"] in self.objects else {"actions": upload | verify})})
        return JSONResponse({"transfer": "basic", "objects": objects})

    async def _lfs_object(self, request: Request, method: str, path: str) -> Response:
        if path == "/lfs/verify":
            wanted = await request.json()
            if len(self.objects.get(wanted["oid"], b"")) != wanted["size"]:
                raise RefusedError(422, "", "The object is missing or has another size")
            return JSONResponse({})
        content, oid = await request.body(), path.rpartition("/")[2]
        if method != "PUT" or hashlib.sha256(content).hexdigest() != oid:
            raise RefusedError(400, "", "The content has another SHA-256")
        self.objects[oid] = content
        return Response()

    async def _commit(self, request: Request, key: str, repository: StoredRepository, argument: str) -> Response:
        lines = [json.loads(line) for line in (await request.body()).splitlines()]
        header = next(line["value"] for line in lines if line["key"] == "header")
        if header.get("parentCommit", repository.branches.get(argument)) != repository.branches.get(argument):
            raise RefusedError(412, "", "A commit has happened since. Please refresh and try again.")
        files = dict(repository.files(argument))
        for line in lines:
            value = line["value"]
            if line["key"] == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif line["key"] == "lfsFile":
                if value["oid"] not in self.objects:
                    raise RefusedError(400, "", f"The object of {value['path']} was not uploaded")
                files[value["path"]] = self.objects[value["oid"]]
            elif line["key"] == "deletedFile":
                del files[value["path"]]
        commit = repository.commit(argument, files, header["summary"])
        url = f"{self.url}/{key}/commit/{commit}"
        return JSONResponse({"commitUrl": url, "commitOid": commit, "pullRequestUrl": None})


def _oid(name: str, content: bytes) -> str:
    """Return the id of a file: SHA-256 of LFS files, git's hash of the others."""
    return hashlib.sha256(content).hexdigest() if name.endswith(LFS_SUFFIXES) else str(git_hash(content))


def _entry(name: str, content: bytes) -> dict[str, Any]:
    """Return the entry of a file in the list of a tree."""
    entry = {"type": "file", "path": name, "size": len(content), "oid": git_hash(content)}
    if not name.endswith(LFS_SUFFIXES):
        return entry
    return {**entry, "lfs": {"oid": _oid(name, content), "size": len(content), "pointerSize": 134}}


def folder_files(root: Path) -> dict[str, bytes]:
    """Return the content of all files of a folder, by path."""
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in root.rglob("*") if path.is_file()}


@contextmanager
def running_hub() -> Iterator[HubServer]:
    """Run a Hub without repositories on a free port."""
    hub = HubServer()
    application = Starlette(
        routes=[Route("/{path:path}", hub.answer, methods=["GET", "HEAD", "POST", "PUT", "DELETE"])]
    )
    server = uvicorn.Server(uvicorn.Config(application, port=0, ws="none", log_config=None, lifespan="off"))
    socket = server.config.bind_socket()
    socket.listen()  # Requests wait until the server runs.
    hub.url = f"http://127.0.0.1:{socket.getsockname()[1]}"
    thread = threading.Thread(target=server.run, kwargs={"sockets": [socket]}, daemon=True)
    thread.start()
    try:
        yield hub
    finally:
        server.should_exit = True
        thread.join()
        socket.close()
