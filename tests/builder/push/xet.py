"""Xet storage of the Hub on this machine: ``hf_xet`` stores content in a folder that it takes for the server."""

from __future__ import annotations

import json
import time
from pathlib import Path

from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from tests.hub_server import HubServer


def accept_xet(hub: HubServer, store: Path) -> dict[str, str]:
    """Let the Hub hand out tokens for ``store``; return the SHA-256 of large files by path, filled by commits.

    The content of a commit is not kept.
    """
    committed = dict[str, str]()
    store.mkdir()

    def token(_: Request) -> Response:
        values = {"casUrl": f"local://{store}", "accessToken": "xet", "exp": int(time.time()) + 3600}
        names = {"casUrl": "X-Xet-Cas-Url", "accessToken": "X-Xet-Access-Token", "exp": "X-Xet-Token-Expiration"}
        return JSONResponse(values, headers={name: str(values[key]) for key, name in names.items()})

    def commit(request: Request) -> Response:
        lines = [json.loads(line) for line in request._body.splitlines()]
        large = [line["value"] for line in lines if line["key"] == "lfsFile"]
        committed.update({value["path"]: value["oid"] for value in large})
        answer = {
            "commitUrl": f"{hub.url}/datasets/org/data/commit/{'c' * 40}",
            "commitOid": "c" * 40,
            "pullRequestUrl": None,
        }
        return JSONResponse(answer)

    hub.faults["GET */xet-write-token/*"] = token
    hub.faults["POST */commit/*"] = commit
    return committed
