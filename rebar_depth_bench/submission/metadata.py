"""Parsing and validation of ``submission.json``, the metadata of a submission."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NoReturn
from urllib.parse import urlsplit

from rebar_depth_bench.errors import escape_text

METADATA_NAME = "submission.json"
MAX_METADATA_BYTES = 4 * 1024 * 1024
MAX_METHOD_CHARACTERS = 200
_MAX_URL_CHARACTERS = 2000
_JSON_TYPE_NAMES = {
    dict: "an object",
    list: "a list",
    str: "text",
    bool: "true or false",
    int: "a number",
    float: "a number",
}


class MetadataError(Exception):
    """Error for an invalid ``submission.json``; ``problems`` are sentences without the entry's name."""

    def __init__(self, problems: list[str]) -> None:
        self.problems = tuple(problems)
        super().__init__("; ".join(problems))


@dataclass(frozen=True, slots=True)
class SubmissionMeta:
    """Values declared in ``submission.json``; None where a key is absent.

    ``depth_scale`` is in metres per unit of a PNG value. ``runtime`` is the author's own report, kept unchanged;
    nothing is computed from it.
    """

    method: str
    description: str | None = None
    url: str | None = None
    uses_intrinsics: bool | None = None
    depth_scale: float | None = None
    runtime: Mapping[str, object] | str | float | None = None


def parse_metadata(data: bytes) -> SubmissionMeta:
    """Parse and validate the bytes of ``submission.json``; unknown keys are ignored.

    Raises ``MetadataError`` with all problems.
    """
    values = _load_object(data)
    problems = [
        *method_problems(values.get("method")),
        *description_problems(values.get("description")),
        *url_problems(values.get("url")),
        *type_problems("uses_intrinsics", values.get("uses_intrinsics"), bool),
        *_scale_problems(values.get("depth_scale")),
        *_runtime_problems(values.get("runtime")),
    ]
    if problems:
        raise MetadataError(problems)
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
        values = json.loads(data.decode("utf-8"), parse_constant=_reject_constant)
        # json.loads accepts numbers like 1e999 and lone surrogates, which cannot be written as JSON again.
        json.dumps(values, allow_nan=False, ensure_ascii=False).encode("utf-8")
    except UnicodeDecodeError as error:
        raise MetadataError([f"byte {error.start} is not UTF-8, expected UTF-8 text"]) from error
    except RecursionError as error:
        raise MetadataError(["the JSON is nested too deep, expected a flat object"]) from error
    except ValueError as error:
        raise MetadataError(
            [f"the text is not valid JSON ({escape_text(str(error))}), expected a JSON object"]
        ) from error
    if not isinstance(values, dict):
        raise MetadataError(
            [f'the JSON is {_json_type_name(values)}, expected an object like {{"method": "name"}}']
        )
    return values


def _reject_constant(text: str) -> NoReturn:
    raise ValueError(f"{text} is not JSON")


def method_problems(method: object) -> list[str]:
    """Return the problems of a method name: it must be printable text of 1 to 200 characters."""
    expected = f"expected a printable name of 1 to {MAX_METHOD_CHARACTERS} characters"
    if method is None:
        return [f"method is missing, {expected}"]
    if not isinstance(method, str):
        return [f"method is {_json_type_name(method)}, {expected}"]
    if not method.strip() or not method.isprintable():
        return [f"method is {escape_text(ascii(method))}, {expected}"]
    if len(method) > MAX_METHOD_CHARACTERS:
        return [f"method has {len(method)} characters, {expected}"]
    return []


def description_problems(description: object) -> list[str]:
    """Return the problems of a description: any text without NUL, which PostgreSQL cannot store."""
    problems = type_problems("description", description, str)
    has_nul = isinstance(description, str) and "\0" in description
    return [*problems, *(["description contains a NUL character, expected text without NUL"] if has_nul else [])]


def url_problems(url: object) -> list[str]:
    """Return the problems of an optional HTTP or HTTPS address; None has no problems."""
    problems = type_problems("url", url, str)
    if problems or not isinstance(url, str):
        return problems
    try:
        parts = urlsplit(url)
        valid = parts.scheme in ("http", "https") and bool(parts.hostname)
    except ValueError:
        valid = False
    valid = valid and url.isprintable() and " " not in url and len(url) <= _MAX_URL_CHARACTERS
    return (
        [] if valid else [f"url is {escape_text(url)}, expected an address that starts with http:// or https://"]
    )


def type_problems(key: str, value: object, expected_type: type) -> list[str]:
    """Return the problem of an optional value that is not an instance of ``expected_type``."""
    if value is None or isinstance(value, expected_type):
        return []
    return [f"{key} is {_json_type_name(value)}, expected {_JSON_TYPE_NAMES[expected_type]}"]


def _scale_problems(scale: object) -> list[str]:
    if scale is None:
        return []
    expected = "expected a finite number of metres per unit above 0"
    if isinstance(scale, bool) or not isinstance(scale, int | float):
        return [f"depth_scale is {_json_type_name(scale)}, {expected}"]
    try:
        valid = math.isfinite(float(scale)) and float(scale) > 0
    except OverflowError:
        valid = False
    return [] if valid else [f"depth_scale is {escape_text(str(scale))}, {expected}"]


def _runtime_problems(runtime: object) -> list[str]:
    if runtime is None or (isinstance(runtime, dict | str | int | float) and not isinstance(runtime, bool)):
        return []
    return [f"runtime is {_json_type_name(runtime)}, expected an object, text or a number"]


def _json_type_name(value: object) -> str:
    return _JSON_TYPE_NAMES.get(type(value), "null")
