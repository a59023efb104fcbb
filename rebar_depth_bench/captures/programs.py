"""Calibrations as OpenCV, ROS and Kalibr write them.

- OpenCV's FileStorage has no fixed names. Those of its stereo sample (M1, D1, M2, D2, R, T), of its calibration
  sample (camera_matrix, distortion_coefficients, image_width), and their common spellings are known. The unit of T
  is that of the calibration target's squares: metres unless another unit is stated.
- ROS: ``camera_info`` as camera_calibration writes it (camera_matrix, ...) or as a printed message (K or k, ...).
  The motion of a pair follows from the rectification of both cameras: x_rectified = R_i x_i, P[0, 3] = -fx B.
- Kalibr: a camera chain with cam0 and, for a pair, cam1 with T_cn_cnm1 = cam1_from_cam0.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.base.errors import Problem, ProblemCode
from rebar_depth_bench.base.reading import parse_number
from rebar_depth_bench.base.validation import format_location, short_repr
from rebar_depth_bench.captures.calibration import Calibration, table_calibration
from rebar_depth_bench.geometry.cameras import is_rotation, nearest_rotation, rotation_matrix

Document = Mapping[str, Any]
Values = Float64[ndarray, "..."]
Fields = Mapping[str, Sequence[str]]
"""Keys of each value that is read; the first one that a document has counts, without case and punctuation."""

_KNOWN_MODEL = "k1 k2 p1 p2 k3 (plumb_bob, radtan); rectify the images first"
_CAMERAS = ("left", "right")
_MAX_NUMBERS = 100
_MAX_MAGNITUDE = 1e9
_ROUNDED_ROTATION = 1e-4
"""Largest deviation of ``R @ R.T`` from the identity in a file with few digits; it is made exact."""
_DISTORTION_TERMS = 5
_MODELS = ("plumb_bob", "radtan", "rational_polynomial", "none", "")
"""Distortion models whose first terms are k1 k2 p1 p2 k3, or of a camera without distortion."""

_ROS: Fields = {
    "matrix": ("camera_matrix", "K"),
    "distortion": ("distortion_coefficients", "D"),
    "model": ("distortion_model",),
    "width": ("image_width", "width"),
    "height": ("image_height", "height"),
    "rotation": ("rectification_matrix", "R"),
    "projection": ("projection_matrix", "P"),
}
_KALIBR: Fields = {
    "matrix": ("intrinsics",),
    "distortion": ("distortion_coeffs",),
    "model": ("distortion_model",),
    "size": ("resolution",),
    "projection model": ("camera_model",),
    "motion": ("T_cn_cnm1",),
}


def _opencv_fields(eyes: Sequence[str]) -> Fields:
    """Return the fields of a camera of OpenCV; ``eyes`` are the spellings of which one, before or after a name."""

    def spellings(*names: str) -> tuple[str, ...]:
        return tuple(spelling for name in names for eye in eyes for spelling in (name + eye, eye + name))

    return {
        "matrix": spellings("M", "K", "camera_matrix", "intrinsics", "intrinsic_matrix", "mtx", "cam_matrix"),
        "distortion": spellings(
            *("D", "distortion", "distortion_coefficients", "distortion_coeffs"),
            *("dist", "dist_coeffs", "dist_coeff"),
        ),
        "model": ("distortion_model",),
        "fisheye": ("fisheye_model",),
        "size": ("image_size", "size", "camera_resolution", "resolution"),
        "width": ("image_width", "width"),
        "height": ("image_height", "height"),
        "rotation": ("R", "rotation", "rotation_matrix", "rmat"),
        "translation": ("T", "translation", "translation_vector", "tvec"),
    }


_OPENCV = _opencv_fields([""])
_OPENCV_PAIR = (_opencv_fields(["1", "left", "l"]), _opencv_fields(["2", "right", "r"]))


@dataclass(frozen=True)
class _Reader:
    """Values of a document ``name``; problems are added to ``problems``, in place of which zeros are returned.

    ``sources`` names the files of the keys of a document that was put together from several.
    """

    name: str
    document: Document
    problems: list[Problem]
    fields: Fields
    sources: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def _keys(self) -> Mapping[str, str]:
        return {_plain(str(key)): key for key in self.document}

    def key(self, name: str) -> str | None:
        """Return the key of a field in the document, None if it has none."""
        return next((self._keys[key] for key in map(_plain, self.fields.get(name, ())) if key in self._keys), None)

    def numbers(self, name: str, *shapes: tuple[int, ...], default: Values | None = None) -> Values:
        """Return the numbers of a field, in one of ``shapes``; a side that is -1 may have any length."""
        key, zeros = self.key(name), np.zeros([max(side, 0) for side in shapes[0]])
        texts = [" x ".join("n" if side < 0 else str(side) for side in shape) for shape in shapes]
        expected = f"numbers of shape {' or '.join(texts)}"
        if key is None and default is None:
            self.problem("missing", name, "missing", expected)
            return zeros
        value = [] if key is None else self.document[key]
        flat = list(_flattened(value.get("data") if isinstance(value, dict) else value))
        if not flat and default is not None:
            return default
        if flat and len(flat) <= _MAX_NUMBERS and np.isfinite(flat).all():
            for shape in shapes:
                if -1 in shape or math.prod(shape) == len(flat):
                    return np.array(flat, np.float64).reshape(shape)
        self.problem("invalid", name, f"got {short_repr(value)}", expected)
        return zeros

    def lens(self) -> dict[str, Any]:
        """Return the table of the lens for ``table_calibration``."""
        if self.fields is _KALIBR:  # Its intrinsics are these four numbers.
            pinhole = dict(zip(("fx", "fy", "cx", "cy"), self.numbers("matrix", (4,)).tolist(), strict=True))
        else:
            pinhole = {"K": self.numbers("matrix", (3, 3)).tolist()}
        terms = self.numbers("distortion", (-1,), default=np.zeros(_DISTORTION_TERMS))
        key = self.key("model")
        model = "" if key is None else self.document[key]
        found = f"the distortion has {len(terms)} terms" if terms[_DISTORTION_TERMS:].any() else ""
        if str(model).lower() not in _MODELS:
            found = f"the distortion model is {short_repr(model)}"
        if found:
            self.problems.append(Problem("invalid", self.name, found, _KNOWN_MODEL))
        distortion = [*terms[:_DISTORTION_TERMS].tolist(), *[0.0] * (4 - len(terms))]
        return {**pinhole, "distortion": distortion}

    def size(self) -> dict[str, float]:
        """Return width and height, from one field with both or from two; nothing if the document has none."""
        if self.key("size"):
            width, height = self.numbers("size", (2,)).tolist()
        elif self.key("width") and self.key("height"):
            width, height = (float(self.numbers(name, (1,))[0]) for name in ("width", "height"))
        else:
            return {}
        sides_px = {"width": width, "height": height}
        return {key: int(side_px) if side_px.is_integer() else side_px for key, side_px in sides_px.items()}

    def rotation(self) -> Values:
        """Return the rotation matrix, which the file may also hold as a rotation vector."""
        rotation = self.numbers("rotation", (3, 3), (3,))
        return rotation_matrix(rotation) if rotation.ndim == 1 else rotation

    def problem(self, code: ProblemCode, name: str, found: str, expected: str) -> None:
        """Add a problem of a field."""
        self.problems.append(Problem(code, self.place(name), found, expected))

    def place(self, name: str) -> str:
        """Return the location of a field."""
        return self.key_place(self.key(name) or self.fields[name][0])

    def key_place(self, key: str) -> str:
        """Return the location of a key."""
        name = self.sources.get(key, self.name)
        return format_location(name if ": " in name else f"{name}:", key)


def program_calibration(
    documents: Mapping[str, Document], width: int, height: int, unit_m: float, problems: list[Problem]
) -> Calibration | None:
    """Return the calibration in one or two documents, by file name; of two, the left camera is the first.

    ``unit_m`` is the unit of lengths in the documents, metres; ``width`` and ``height`` are the image size where
    the documents state none. Problems are added to ``problems``; the result is None if there are any.
    """
    cameras = [_Reader(name, document, problems, _ROS) for name, document in documents.items()]
    find_motion: Callable[[_Reader, _Reader, float], tuple[Values, Values]] = _ros_motion
    if not any(camera.key("matrix") and camera.key("projection") for camera in cameras):
        merged = _merged(documents, problems)
        if "cam0" in merged.document:
            cameras, find_motion = _kalibr_cameras(merged), _kalibr_motion
        else:
            cameras, find_motion = _opencv_cameras(merged), _opencv_motion
    table: dict[str, Any] = {eye: one.lens() for eye, one in zip(_CAMERAS, cameras, strict=False)}
    table |= cameras[0].size()
    if len(cameras) == 2:
        rotation, translation_m = find_motion(cameras[0], cameras[1], unit_m)
        if not is_rotation(rotation) and is_rotation(rotation, _ROUNDED_ROTATION):
            rotation = nearest_rotation(rotation)
        table["stereo"] = {"rotation": rotation.tolist(), "translation_m": translation_m.tolist()}
    if problems:
        return None
    table_problems: list[Problem] = []
    calibration = table_calibration(table, width, height, table_problems, is_stereo=len(cameras) == 2)
    for problem in table_problems:
        eye, _, key = problem.where.partition(".")
        place = cameras[eye == _CAMERAS[1]].place("matrix")
        problems.append(replace(problem, where=place, found=f"{key or eye}: {problem.found}"))
    return calibration


def _merged(documents: Mapping[str, Document], problems: list[Problem]) -> _Reader:
    """Return the reader of all keys of the documents; a key with two values adds a problem."""
    merged: dict[str, Any] = {}
    sources: dict[str, str] = {}
    for name, document in documents.items():
        for key, value in document.items():
            if key in merged and value != merged[key]:
                place = format_location(f"{name}:", key)
                problems.append(Problem("duplicate", place, f"differs from that in {sources[key]}", "one value"))
            merged.setdefault(key, value)
            sources.setdefault(key, name)
    return _Reader(next(iter(documents)), merged, problems, _OPENCV, sources)


def _ros_motion(left: _Reader, right: _Reader, unit_m: float) -> tuple[Values, Values]:
    """Return rotation and translation (metres) of ``x_right = R x_left + T``."""
    left_rotation, right_rotation = left.rotation(), right.rotation()
    row = right.numbers("projection", (3, 4))[0]
    fx, x = row[0], row[3]
    if not fx > 0 > x:
        expected = "fx above 0 and P[0, 3] = -fx * baseline, of the right camera of a calibrated pair"
        right.problem("invalid", "projection", f"got {short_repr(row.tolist())}", expected)
        return np.eye(3), np.zeros(3)
    right_from_rectified = right_rotation.T
    return right_from_rectified @ left_rotation, right_from_rectified @ np.array([x / fx * unit_m, 0.0, 0.0])


def _kalibr_cameras(chain: _Reader) -> list[_Reader]:
    cameras = []
    for name in ("cam0", "cam1"):
        if name in chain.document:
            table, place = chain.document[name], chain.key_place(name)
            if not isinstance(table, dict):
                chain.problems.append(Problem("invalid", place, f"got {short_repr(table)}", "a table"))
                table = {}
            cameras.append(_Reader(place, table, chain.problems, _KALIBR))
            model = table.get("camera_model", "pinhole")
            if model != "pinhole":
                cameras[-1].problem("invalid", "projection model", f"got {short_repr(model)}", "pinhole")
    return cameras


def _kalibr_motion(_: _Reader, right: _Reader, unit_m: float) -> tuple[Values, Values]:
    """Return rotation and translation (metres) of ``x_right = R x_left + T``."""
    right_from_left = right.numbers("motion", (4, 4))
    return right_from_left[:3, :3], unit_m * right_from_left[:3, 3]


def _opencv_cameras(storage: _Reader) -> list[_Reader]:
    """Return the readers of both cameras, or of one if the document has no matrix of a right camera."""
    if float(storage.numbers("fisheye", (1,), default=np.zeros(1))[0]):
        storage.problem("invalid", "fisheye", "got a fisheye calibration", _KNOWN_MODEL)
    pair = [replace(storage, fields=fields) for fields in _OPENCV_PAIR]
    right = pair[1].key("matrix")
    is_pair = right is not None and isinstance(storage.document[right], dict | list)
    return pair if is_pair else [storage]


def _opencv_motion(left: _Reader, _: _Reader, unit_m: float) -> tuple[Values, Values]:
    """Return rotation and translation (metres) of ``x_right = R x_left + T``."""
    return left.rotation(), unit_m * left.numbers("translation", (3,))


def _plain(key: str) -> str:
    """Return a key without case and punctuation."""
    return re.sub("[^a-z0-9]", "", key.lower())


def _flattened(value: Any) -> Iterable[float]:
    """Yield the numbers in nested lists; NaN for anything else."""
    if isinstance(value, list | tuple):
        for item in value:
            yield from _flattened(item)
    else:
        number = parse_number(value) if isinstance(value, str) else value
        is_number = isinstance(number, int | float) and not isinstance(number, bool)
        yield float(number) if is_number and abs(number) <= _MAX_MAGNITUDE else math.nan
