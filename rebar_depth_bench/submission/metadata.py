"""``submission.json``: who made the predictions, and how their PNG values become metres."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NoReturn
from urllib.parse import urlsplit

from rebar_depth_bench.errors import show

METADATA_NAME = "submission.json"
MAX_METADATA_BYTES = 4 * 1024 * 1024
MAX_METHOD_CHARACTERS = 200
_MAX_URL_CHARACTERS = 2000
_KINDS = {
    dict: "an object",
    list: "a list",
    str: "text",
    bool: "true or false",
    int: "a number",
    float: "a number",
}


class MetadataError(Exception):
    """``submission.json`` is refused; ``problems`` are sentences without the entry's name."""

    def __init__(self, problems: list[str]) -> None:
        self.problems = tuple(problems)
        super().__init__("; ".join(problems))


@dataclass(frozen=True, slots=True)
class SubmissionMeta:
    """What ``submission.json`` declares; ``depth_scale`` is metres per unit of a PNG value.

    ``runtime`` is what the method's author reports, as it stands in the file; nothing is computed from it.
    """

    method: str
    description: str | None = None
    url: str | None = None
    uses_intrinsics: bool | None = None
    depth_scale: float | None = None
    runtime: Mapping[str, object] | str | float | None = None


def parse_metadata(data: bytes) -> SubmissionMeta:
    """Parse and validate the bytes of ``submission.json``; unknown keys are ignored.

    Raises ``MetadataError`` with everything that is wrong.
    """
    values = _load_object(data)
    found = [
        *method_problems(values.get("method")),
        *description_problems(values.get("description")),
        *url_problems(values.get("url")),
        *type_problems("uses_intrinsics", values.get("uses_intrinsics"), bool),
        *_scale_problems(values.get("depth_scale")),
        *_runtime_problems(values.get("runtime")),
    ]
    if found:
        raise MetadataError(found)
    scale = values.get("depth_scale")
    return SubmissionMeta(
        method=values["method"],
        description=values.get("description"),
        url=values.get("url"),
        uses_intrinsics=values.get("uses_intrinsics"),
        depth_scale=None if scale is None else float(scale),
        runtime=values.get("runtime"),
    )


def _load_object(data: bytes) -> dict[str, Any]:
    if len(data) > MAX_METADATA_BYTES:
        raise MetadataError([f"the size is {len(data)} bytes, expected at most {MAX_METADATA_BYTES}"])
    try:
        values = json.loads(data.decode("utf-8"), parse_constant=_refuse_constant)
        # A number like 1e999 or half a surrogate pair parses, and then breaks whoever writes it out again.
        json.dumps(values, allow_nan=False, ensure_ascii=False).encode("utf-8")
    except UnicodeDecodeError as error:
        raise MetadataError([f"byte {error.start} is not UTF-8, expected UTF-8 text"]) from error
    except RecursionError as error:
        raise MetadataError(["the JSON is nested too deep, expected a flat object"]) from error
    except ValueError as error:
        raise MetadataError(
            [f"the text is not valid JSON ({show(str(error))}), expected a JSON object"]
        ) from error
    if not isinstance(values, dict):
        raise MetadataError([f'the JSON is {_kind(values)}, expected an object like {{"method": "name"}}'])
    return values


def _refuse_constant(text: str) -> NoReturn:
    raise ValueError(f"{text} is not JSON")


def method_problems(method: object) -> list[str]:
    """Return what is wrong with a method's name: a printable one of at most 200 characters is expected."""
    expected = f"expected a printable name of 1 to {MAX_METHOD_CHARACTERS} characters"
    if method is None:
        return [f"method is missing, {expected}"]
    if not isinstance(method, str):
        return [f"method is {_kind(method)}, {expected}"]
    if not method.strip() or not method.isprintable():
        return [f"method is {show(ascii(method))}, {expected}"]
    if len(method) > MAX_METHOD_CHARACTERS:
        return [f"method has {len(method)} characters, {expected}"]
    return []


def description_problems(description: object) -> list[str]:
    """Return what is wrong with a description: any text will do, but for NUL, which PostgreSQL does not keep."""
    found = type_problems("description", description, str)
    has_nul = isinstance(description, str) and "\0" in description
    return [*found, *(["description has a NUL character, expected text without one"] if has_nul else [])]


def url_problems(url: object) -> list[str]:
    """Return what is wrong with an address; none at all is fine."""
    found = type_problems("url", url, str)
    if found or not isinstance(url, str):
        return found
    try:
        parts = urlsplit(url)
        sound = parts.scheme in ("http", "https") and bool(parts.hostname)
    except ValueError:
        sound = False
    sound = sound and url.isprintable() and " " not in url and len(url) <= _MAX_URL_CHARACTERS
    return [] if sound else [f"url is {show(url)}, expected an address that starts with http:// or https://"]


def type_problems(key: str, value: object, kind: type) -> list[str]:
    """Return the problem of an optional value that is not of its kind."""
    if value is None or isinstance(value, kind):
        return []
    return [f"{key} is {_kind(value)}, expected {_KINDS[kind]}"]


def _scale_problems(scale: object) -> list[str]:
    if scale is None:
        return []
    expected = "expected a finite number of metres per unit above 0"
    if isinstance(scale, bool) or not isinstance(scale, int | float):
        return [f"depth_scale is {_kind(scale)}, {expected}"]
    try:
        sound = math.isfinite(float(scale)) and float(scale) > 0
    except OverflowError:
        sound = False
    return [] if sound else [f"depth_scale is {show(str(scale))}, {expected}"]


def _runtime_problems(runtime: object) -> list[str]:
    if runtime is None or (isinstance(runtime, dict | str | int | float) and not isinstance(runtime, bool)):
        return []
    return [f"runtime is {_kind(runtime)}, expected an object, text or a number"]


def _kind(value: object) -> str:
    return _KINDS.get(type(value), "null")
