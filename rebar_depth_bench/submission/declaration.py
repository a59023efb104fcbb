"""Parsing and validation of ``submission.json``, the metadata of a submission."""

from __future__ import annotations

import math
import re
import statistics
import unicodedata
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args
from urllib.parse import urlsplit

from pydantic import AfterValidator, ConfigDict

from rebar_depth_bench.base.errors import Problem
from rebar_depth_bench.base.reading import parse_json
from rebar_depth_bench.base.validation import (
    Expected,
    Flag,
    StrictModel,
    field_error,
    number,
    one_of,
    short_repr,
    text,
    validate_table,
)

METADATA_NAME = "submission.json"
DEPTH_SCALE = f"{METADATA_NAME}: depth_scale"
"""Location of the key that an archive with PNG entries requires."""
MAX_METADATA_BYTES = 4 * 1024 * 1024
MAX_METHOD_CHARACTERS = 200
MAX_DESCRIPTION_CHARACTERS = 4000
MAX_NUMBER = 1e18
"""Largest magnitude of a number: it fits a float and 64 bits."""
_MAX_URL_CHARACTERS = 2000


def is_http_url(url: str) -> bool:
    """Return whether ``url`` is a printable HTTP or HTTPS address of at most 2000 characters."""
    try:
        parts = urlsplit(url)
        valid = parts.scheme in ("http", "https") and bool(parts.hostname)
    except ValueError:
        return False
    return valid and url.isprintable() and " " not in url and len(url) <= _MAX_URL_CHARACTERS


def _check_numbers(runtime: Any) -> Any:
    """Return ``runtime``; raise the error of a field if a number in it is larger than ``MAX_NUMBER``."""
    values = [runtime]
    for value in values:
        if isinstance(value, dict):
            values += value.values()
        elif isinstance(value, list):
            values += value
        elif isinstance(value, int | float) and not abs(value) <= MAX_NUMBER:
            raise field_error(f"got the number {short_repr(value)}", f"numbers of at most {MAX_NUMBER:g}")
    return runtime


_Method = Annotated[
    str,
    text(MAX_METHOD_CHARACTERS, "a printable name"),
    # A character can become 18, and the leaderboard stores this form.
    Expected(
        f"a name of at most {MAX_METHOD_CHARACTERS} characters in Unicode form NFKC",
        lambda value: len(unicodedata.normalize("NFKC", value)) <= MAX_METHOD_CHARACTERS,
    ),
]
# PostgreSQL cannot store NUL, and UTF-8 has no surrogates.
_Description = Annotated[
    str,
    Expected(
        f"text of at most {MAX_DESCRIPTION_CHARACTERS} characters without NUL and surrogates",
        lambda value: len(value) <= MAX_DESCRIPTION_CHARACTERS and not re.search("[\0\ud800-\udfff]", value),
    ),
]
HttpUrl = Annotated[
    str,
    Expected(
        f"an http:// or https:// address without spaces, at most {_MAX_URL_CHARACTERS} characters", is_http_url
    ),
]
_Scale = Annotated[float, number(0, MAX_NUMBER, f"a number of metres per unit above 0, at most {MAX_NUMBER:g}")]
_Runtime = Annotated[
    dict[Any, Any] | str | int | float,
    Expected("an object, text or a number"),
    AfterValidator(_check_numbers),
]
_Parameters = Annotated[
    int | float | str,
    Expected(
        f"a number from 0 to {MAX_NUMBER:g} or printable text of at most 100 characters",
        lambda value: (
            0 < len(value.strip()) <= 100 and value.isprintable()
            if isinstance(value, str)
            else 0 <= value <= MAX_NUMBER
        ),
    ),
]


InputClass = Literal["rgb", "rgb+K", "stereo", "multi-view", "lidar"]
INPUTS: tuple[str, ...] = get_args(InputClass)
"""Input classes of methods, within which submissions are ranked too."""


PredictionKind = Literal["metric", "scale", "affine-depth", "affine-disparity"]
METRIC = "metric"
PREDICTION_KINDS: tuple[str, ...] = get_args(PredictionKind)
"""Kinds of predictions: metres, depth up to a scale, depth and disparity up to scale and shift."""
RANKS_METRIC = "the leaderboard ranks depth in metres"
"""Reason why other predictions are not ranked."""


@dataclass(frozen=True)
class Declaration:
    """What a submission declares about itself; None where it does not.

    ``inputs`` is one of ``INPUTS``. ``uses_ground_truth`` is true if prediction or tuning reads ground truth of
    the scored config: depth, masks, bars, meshes or camera poses. Neither is verified.
    """

    inputs: str | None = None
    uses_ground_truth: bool | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the declaration as a JSON-compatible object."""
        return {"inputs": self.inputs, "uses_ground_truth": self.uses_ground_truth}


NOT_DECLARED = Declaration()
"""Declaration of a submission that declares nothing."""


class MethodDetails(StrictModel):
    """What a submitter says about a method, without effect on scores; None where it is not given.

    ``parameters`` is the number of learned parameters, or text.
    """

    description: _Description | None = None
    url: HttpUrl | None = None
    code_url: HttpUrl | None = None
    licence: Annotated[str, text(100)] | None = None
    training_data: Annotated[str, text(1000)] | None = None
    parameters: _Parameters | None = None


class SubmissionMeta(MethodDetails):
    """Values declared in ``submission.json``; None where a key is absent. Unknown keys are ignored.

    ``inputs`` and ``uses_ground_truth`` are those of ``Declaration``, ``prediction`` is one of
    ``PREDICTION_KINDS``. ``depth_scale`` is in metres per unit of a PNG value. ``runtime`` is the author's own
    report, kept unchanged; nothing is computed from it.
    """

    model_config = ConfigDict(extra="ignore")

    method: _Method
    inputs: Annotated[str, one_of(*INPUTS)] | None = None
    uses_ground_truth: Flag | None = None
    prediction: Annotated[str, one_of(*PREDICTION_KINDS)] = METRIC
    depth_scale: _Scale | None = None
    runtime: _Runtime | None = None

    @property
    def declaration(self) -> Declaration:
        """What the submission declares."""
        return Declaration(self.inputs, self.uses_ground_truth)

    def kind_problems(self, use: str) -> list[Problem]:
        """Return the problem of predictions that are not metric, which ``use`` requires; none if they are."""
        if self.prediction == METRIC:
            return []
        found = f"the predictions are of the kind {self.prediction}"
        return [Problem("conflict", f"{METADATA_NAME}: prediction", found, f"{METRIC} ones: {use}")]

    @property
    def seconds_per_view(self) -> float | None:
        """Median runtime per view in seconds, if ``runtime`` is a number or an object with the key ``seconds``."""
        seconds = self.runtime.get("seconds") if isinstance(self.runtime, dict) else self.runtime
        found = list(seconds.values()) if isinstance(seconds, dict) else [seconds]
        values = [value for value in found if isinstance(value, int | float) and 0 <= value < math.inf]
        return statistics.median(map(float, values)) if values and len(values) == len(found) else None


def parse_metadata(data: bytes) -> tuple[SubmissionMeta | None, list[Problem]]:
    """Return the validated content of ``submission.json``, or None and all its problems; null means absent."""
    if len(data) > MAX_METADATA_BYTES:
        return None, [Problem("size", METADATA_NAME, "it is too large", f"at most {MAX_METADATA_BYTES} bytes")]
    values, problems = parse_json(data, METADATA_NAME)
    if problems:
        return None, problems
    if not isinstance(values, dict):
        expected = 'an object like {"method": "name"}'
        return None, [Problem("invalid", METADATA_NAME, "the JSON is not an object", expected)]
    present = {key: value for key, value in values.items() if value is not None}
    return validate_table(SubmissionMeta, present, problems, f"{METADATA_NAME}:"), problems
