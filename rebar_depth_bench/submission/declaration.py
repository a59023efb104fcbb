"""Parsing and validation of ``submission.json``, the metadata of a submission."""

from __future__ import annotations

import math
import re
import statistics
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args
from urllib.parse import urlsplit

from pydantic import ConfigDict

from rebar_depth_bench.base.errors import Problem
from rebar_depth_bench.base.reading import parse_json
from rebar_depth_bench.base.validation import Expected, Flag, StrictModel, one_of, text, validate_table

METADATA_NAME = "submission.json"
DEPTH_SCALE = f"{METADATA_NAME}: depth_scale"
"""Location of the key that an archive with PNG entries requires."""
MAX_METADATA_BYTES = 4 * 1024 * 1024
MAX_METHOD_CHARACTERS = 200
_MAX_URL_CHARACTERS = 2000


def is_http_url(url: str) -> bool:
    """Return whether ``url`` is a printable HTTP or HTTPS address of at most 2000 characters."""
    try:
        parts = urlsplit(url)
        valid = parts.scheme in ("http", "https") and bool(parts.hostname)
    except ValueError:
        return False
    return valid and url.isprintable() and " " not in url and len(url) <= _MAX_URL_CHARACTERS


# PostgreSQL cannot store NUL, and UTF-8 has no surrogates.
_Description = Annotated[
    str, Expected("text without NUL and surrogates", lambda value: not re.search("[\0\ud800-\udfff]", value))
]
HttpUrl = Annotated[
    str,
    Expected(
        f"an http:// or https:// address without spaces, at most {_MAX_URL_CHARACTERS} characters", is_http_url
    ),
]
_Scale = Annotated[
    float, Expected("a finite number of metres per unit above 0", lambda value: 0 < value < math.inf)
]
_Runtime = Annotated[dict[Any, Any] | str | int | float, Expected("an object, text or a number")]
_Parameters = Annotated[
    int | float | str,
    Expected(
        "a finite number from 0 or printable text of at most 100 characters",
        lambda value: (
            0 < len(value.strip()) <= 100 and value.isprintable()
            if isinstance(value, str)
            else 0 <= value < math.inf
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

    method: Annotated[str, text(MAX_METHOD_CHARACTERS, "a printable name")]
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
