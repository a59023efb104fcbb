"""Style sheets, scripts and the icon, of this package and of the report, and a picture of each config.

URLs of files contain a digest, so that browsers can keep a file and fetch a new version when it changes.
"""

from __future__ import annotations

import hashlib
import io
from importlib.resources import files

from fastapi import APIRouter, HTTPException, Request, Response
from PIL import Image

from leaderboard.web.dependencies import ServiceDep
from rebar_depth_bench.data.manifest import DatasetFolder
from rebar_depth_bench.data.rows import iterate_rows

router = APIRouter(include_in_schema=False)

_REPORT, _OWN = files("rebar_depth_bench.reporting.html"), files("leaderboard.web.pages").joinpath("static")
_STYLE, _SCRIPT = "text/css; charset=utf-8", "text/javascript; charset=utf-8"
STATIC = {
    "report.css": (_REPORT.joinpath("report.css").read_bytes(), _STYLE),
    "sortable.js": (_REPORT.joinpath("sortable.js").read_bytes(), _SCRIPT),
    "page.css": (_OWN.joinpath("page.css").read_bytes(), _STYLE),
    "page.js": (_OWN.joinpath("page.js").read_bytes(), _SCRIPT),
    "icon.svg": (_OWN.joinpath("icon.svg").read_bytes(), "image/svg+xml"),
}
"""Content and media type of the files."""
_DIGESTS = {name: hashlib.sha256(content).hexdigest()[:16] for name, (content, _) in STATIC.items()}
_MAX_AGE_S, _IMMUTABLE_MAX_AGE_S = 300, 31536000
"""Cache lifetimes without and with the current digest in the URL."""
_SCENE_WIDTH, _SCENE_AGE_S = 480, 3600


def static_path(name: str) -> str:
    """Return the URL path of a file below the root path, with its digest."""
    return f"/static/{name}?v={_DIGESTS[name]}"


@router.get("/static/{name}", name="static")
def static(name: str, request: Request, v: str = "") -> Response:
    """Return a file, or 304 if the client's copy is current."""
    if name not in STATIC:
        raise HTTPException(404, "no such file")
    (content, media_type), digest = STATIC[name], _DIGESTS[name]
    lifetime = f"max-age={_IMMUTABLE_MAX_AGE_S}, immutable" if v == digest else f"max-age={_MAX_AGE_S}"
    headers = {"ETag": f'"{digest}"', "Cache-Control": f"public, {lifetime}"}
    if digest in request.headers.get("if-none-match", ""):
        return Response(status_code=304, headers=headers)
    return Response(content, media_type=media_type, headers=headers)


@router.get("/scenes/{config}.webp")
def scene(config: str, service: ServiceDep) -> Response:
    """Return a picture of a config. Raises status 404 if the config is unknown or has no colour."""
    if config in service.folder.configs and config not in service.scenes:
        service.scenes[config] = _scene_webp(service.folder, config)
    webp = service.scenes.get(config)
    if webp is None:
        raise HTTPException(404, "there is no such config, or it has no colour")
    headers = {"Cache-Control": f"public, max-age={_SCENE_AGE_S}"}
    return Response(webp, media_type="image/webp", headers=headers)


def _scene_webp(folder: DatasetFolder, config: str) -> bytes | None:
    """Return the left image of the first view, reduced, as WebP, or None if the config has no colour.

    Raises ``DatasetError`` if the shard cannot be read.
    """
    shown = folder.config(config)
    row = next(iterate_rows(shown, ("view_id", "left_rgb")), None)
    rgb = None if row is None else row["left_rgb"]
    if rgb is None:
        return None
    image = Image.fromarray(rgb)
    image.thumbnail((_SCENE_WIDTH, _SCENE_WIDTH))
    out = io.BytesIO()
    image.save(out, "WEBP", quality=80)
    return out.getvalue()
