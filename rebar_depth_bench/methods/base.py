"""Method types: a description, the dataset columns that a method reads, and its loader."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray

from rebar_depth_bench.base.errors import MethodError, install_command
from rebar_depth_bench.base.parallel import Progress
from rebar_depth_bench.data.rows import POSE_COLUMNS, TRUTH_COLUMNS, Views
from rebar_depth_bench.submission.declaration import METRIC, PREDICTION_KINDS

Predictor = Callable[[Mapping[str, Any]], Float32[ndarray, "h w"]]
"""Function from a decoded row to planar depth of the left view, metres, on the left grid; NaN: no prediction.

Of a method of another kind, the values are those of its kind.
"""

VIEW_TIMEOUT_S = 600.0
"""Default time limit on the inference of a view by an ONNX model, seconds."""


@dataclass(frozen=True)
class MethodInfo:
    """Description of a method, shown in listings and written into submissions.

    ``columns`` are the dataset columns that the predictor reads. ``uses_ground_truth`` is True if the method reads
    ground truth, so that its submissions are not ranked; it must be if ``columns`` has any of ``TRUTH_COLUMNS``,
    or of ``POSE_COLUMNS`` but not both with ``right_rgb``. ``untested_note`` states which part was never run by
    the authors because weights or hardware were not available; empty if everything was tested. ``inputs`` is the
    input class, one of ``INPUTS``; without it, ``input_class`` derives the class from the columns. ``prediction``
    is the kind of the predictions, one of ``PREDICTION_KINDS``.
    """

    name: str
    summary: str
    columns: tuple[str, ...]
    uses_intrinsics: bool
    source: str
    licence: str
    uses_ground_truth: bool = False
    untested_note: str = ""
    inputs: str | None = None
    prediction: str = METRIC

    def __post_init__(self) -> None:
        if isinstance(self.columns, str):  # Catches a one-element tuple written without its comma.
            raise MethodError(f"{self.name}: columns is the text {self.columns!r}, expected a tuple of names")
        if self.prediction not in PREDICTION_KINDS:
            expected = f"expected one of {', '.join(PREDICTION_KINDS)}"
            raise MethodError(f"{self.name}: prediction is {self.prediction!r}, {expected}")
        # Stereo methods need both poses for that of the right eye from the left one.
        is_stereo = {"right_rgb", *POSE_COLUMNS} <= set(self.columns)
        self.check_truth(self.columns, TRUTH_COLUMNS if is_stereo else (*TRUTH_COLUMNS, *POSE_COLUMNS))

    def check_truth(self, read: Sequence[str], truth: Sequence[str]) -> None:
        """Raise ``MethodError`` if any of the names ``read`` is in ``truth`` and its use is not declared."""
        found = ", ".join(name for name in read if name in truth)
        if found and not self.uses_ground_truth:
            raise MethodError(f"{self.name}: reads {found}, expected MethodInfo(..., uses_ground_truth=True)")


@dataclass(frozen=True)
class Method:
    """Single-view method; ``load()`` returns the predictor or raises ``MethodError`` if parts are missing.

    ``notes(row)``, if given, returns notes on a config as plain JSON values from its first row, for example
    settings that depend on the rig; they are written into submissions.
    """

    info: MethodInfo
    load: Callable[[], Predictor]
    notes: Callable[[Mapping[str, Any]], Mapping[str, Any]] | None = None


@dataclass(frozen=True)
class WeightsMethod(Method):
    """Single-view method whose weights, or code and weights, are not part of this package.

    ``with_weights(folder)`` returns the method with those in a folder (``NAME:FOLDER``), or for None (the bare
    name) those in a local cache, which are downloaded if they are missing. Their commit is part of its
    description. Raises ``MethodError`` if they are missing or cannot be downloaded.
    """

    with_weights: Callable[[Path | None], Method] = field(kw_only=True)


@dataclass(frozen=True)
class Prepared:
    """Predictor made from all views of a config, and notes on the preparation as plain JSON values."""

    predict: Predictor
    notes: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class MultiViewMethod:
    """Method that reads all views of a config before it predicts any of them.

    ``check(views)`` raises ``MethodError`` if the config is unsuitable (for example without a board) or a package
    is missing; it is called for every config before any work begins. ``prepare(views, work, progress)`` makes the
    predictor from all views: ``views.rows("left_rgb", "left_K")`` yields decoded rows, and ``views`` also has
    ``view_ids``, ``grid``, ``board`` and ``mesh``; ``TRUTH_COLUMNS`` and the mesh raise ``MethodError`` unless
    ``info.uses_ground_truth`` is True. ``progress("what", done, total)`` reports progress. Files in the folder
    ``work`` persist until an interrupted run is resumed. The rows passed to the predictor hold ``view_id`` and
    ``info.columns``.
    """

    info: MethodInfo
    prepare: Callable[[Views, Path, Progress], Prepared]
    check: Callable[[Views], None]


AnyMethod = Method | MultiViewMethod


def input_class(method: AnyMethod) -> str | None:
    """Return the input class that submissions of a method declare, None if it reads no image.

    A multi-view method has the class ``multi-view``, and a method that reads the right image ``stereo``. Another
    method has ``rgb+K`` if it uses intrinsics, else ``rgb``.
    """
    info = method.info
    if info.inputs is not None:
        return info.inputs
    if isinstance(method, MultiViewMethod):
        return "multi-view"
    if "right_rgb" in info.columns:
        return "stereo"
    if "left_rgb" in info.columns:
        return "rgb+K" if info.uses_intrinsics else "rgb"
    return None


def positive_or_nan(depth_m: Float[ndarray, "*grid"]) -> Float32[ndarray, "*grid"]:
    """Return depth as float32, with NaN (no prediction) where it is not finite or not above 0."""
    single = finite_or_nan(depth_m)
    return np.where(single > 0, single, np.float32(np.nan))


def finite_or_nan(values: Float[ndarray, "*grid"]) -> Float32[ndarray, "*grid"]:
    """Return values as float32, with NaN (no prediction) where they are not finite."""
    with np.errstate(over="ignore"):
        single = values.astype(np.float32)
    return np.where(np.isfinite(single), single, np.float32(np.nan))


def import_optional(module: str, need: str, extra: str) -> Any:
    """Import and return a module that an extra installs, or that imports packages of it.

    Raises ``MethodError`` with ``need``, who needs what, and install instructions if a package is missing.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MethodError(f"{need} ({error}): {install_command(extra)}") from None
