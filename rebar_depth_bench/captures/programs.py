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
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.captures.calibration import ROTATION_TOLERANCE, Calibration, table_calibration
from rebar_depth_bench.errors import Problem
from rebar_depth_bench.geometry.cameras import rotation_matrix
from rebar_depth_bench.reading import parse_number
from rebar_depth_bench.validation import format_location, short_repr

Document = Mapping[str, Any]
Values = Float64[ndarray, "..."]

_KNOWN_MODEL = "k1 k2 p1 p2 k3 (plumb_bob, radtan); rectify the images first"
_CAMERAS = ("left", "right")
_MAX_NUMBERS = 100
_MAX_MAGNITUDE = 1e9
_ROUNDED_ROTATION = 1e-4
"""Largest deviation of ``R @ R.T`` from the identity in a file with few digits; it is made exact."""
_DISTORTION_TERMS = 5
_MODELS = ("plumb_bob", "radtan", "rational_polynomial", "none", "")
"""Distortion models whose first terms are k1 k2 p1 p2 k3, or of a camera without distortion."""


class _Reader:
    """Values of a document ``name``; problems are added to ``problems``, in place of which zeros are returned.

    ``sources`` names the files of the keys of a document that was put together from several.
    """

    def __init__(
        self, name: str, document: Document, problems: list[Problem], sources: Mapping[str, str] | None = None
    ) -> None:
        self.name, self.document, self._problems, self._sources = name, document, problems, sources or {}
        self._keys = {_plain(str(key)): key for key in document}

    def key(self, names: Iterable[str]) -> str | None:
        """Return the first key that the document has, compared without case and punctuation."""
        return next((self._keys[_plain(name)] for name in names if _plain(name) in self._keys), None)

    def has(self, names: Iterable[str]) -> bool:
        """Return whether the document has one of the keys."""
        return self.key(names) is not None

    def numbers(self, names: Sequence[str], shape: tuple[int, ...], default: Values | None = None) -> Values:
        """Return the numbers of the first key; a side of ``shape`` that is -1 may have any length."""
        key = self.key(names)
        if key is None:
            if default is None:
                self.problem("missing", names[0], "missing", f"numbers of shape {_shape_text(shape)}")
            return np.zeros([max(side, 0) for side in shape]) if default is None else default
        value = self.document[key]
        flat = list(_flattened(value.get("data") if isinstance(value, dict) else value))
        if not flat and default is not None:
            return default
        if flat and len(flat) <= _MAX_NUMBERS and np.isfinite(flat).all():
            try:
                return np.array(flat, np.float64).reshape(shape)
            except ValueError:
                pass
        self.problem("invalid", key, f"got {short_repr(value)}", f"numbers of shape {_shape_text(shape)}")
        return np.zeros([max(side, 0) for side in shape])

    def table(self, key: str) -> _Reader:
        """Return the reader of a table in the document."""
        value = self.document.get(key)
        if not isinstance(value, dict):
            self.problem("invalid", key, f"got {short_repr(value)}", "a table")
            value = {}
        return _Reader(self.place(key), value, self._problems)

    def lens(self, matrix: Values, distortion: Values, model: object = "") -> dict[str, Any]:
        """Return the table of a lens for ``table_calibration``."""
        if str(model).lower() not in _MODELS:
            self._unknown_model(f"the distortion model is {short_repr(model)}")
        elif distortion[_DISTORTION_TERMS:].any():
            self._unknown_model(f"the distortion has {len(distortion)} terms")
        terms = [*distortion[:_DISTORTION_TERMS].tolist(), *[0.0] * (4 - len(distortion))]
        return {"K": matrix.tolist(), "distortion": terms}

    def problem(self, code: Any, key: str, found: str, expected: str) -> None:
        """Add a problem at a key."""
        self._problems.append(Problem(code, self.place(key), found, expected))

    def place(self, key: str) -> str:
        """Return the location of a key."""
        name = self._sources.get(key, self.name)
        return format_location(name if ": " in name else f"{name}:", key)

    def place_of(self, names: Iterable[str]) -> str:
        """Return the location of the first key that the document has."""
        return self.place(self.key(names) or "")

    def _unknown_model(self, found: str) -> None:
        self._problems.append(Problem("invalid", self.name, found, _KNOWN_MODEL))


def program_calibration(
    documents: Mapping[str, Document], width: int, height: int, unit_m: float, problems: list[Problem]
) -> Calibration | None:
    """Return the calibration in one or two documents, by file name; of two, the left camera is the first.

    ``unit_m`` is the unit of lengths in the documents, metres; ``width`` and ``height`` are the image size where
    the documents state none. Problems are added to ``problems``; the result is None if there are any.
    """
    readers = [_Reader(name, document, problems) for name, document in documents.items()]
    if any(one.has(_ROS_MATRIX) and one.has(_ROS_PROJECTION) for one in readers):
        cameras = _ros(readers, unit_m)
    else:
        merged = _merged(documents, problems)
        cameras = _kalibr(merged, unit_m) if "cam0" in merged.document else _opencv(merged, unit_m)
    if problems:
        return None
    table_problems: list[Problem] = []
    is_stereo = "stereo" in cameras.table
    calibration = table_calibration(cameras.table, width, height, table_problems, is_stereo=is_stereo)
    problems += map(cameras.located, table_problems)
    return calibration


@dataclass(frozen=True)
class _Cameras:
    """Table of a calibration, as ``calibration_toml`` reads it, and locations of the matrix of each camera."""

    table: Mapping[str, Any]
    places: Sequence[str]

    def located(self, problem: Problem) -> Problem:
        """Return a problem of the table with its location in the documents."""
        part, _, key = problem.where.partition(".")
        return replace(problem, where=self.places[part == _CAMERAS[1]], found=f"{key or part}: {problem.found}")


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
    return _Reader(next(iter(documents)), merged, problems, sources)


def _kalibr(chain: _Reader, unit_m: float) -> _Cameras:
    cameras = [chain.table(name) for name in ("cam0", "cam1") if name in chain.document]
    table: dict[str, Any] = {}
    for eye, camera in zip(_CAMERAS, cameras, strict=False):
        model = camera.document.get("camera_model", "pinhole")
        if model != "pinhole":
            camera.problem("invalid", "camera_model", f"got {short_repr(model)}", "pinhole")
        fx, fy, cx, cy = camera.numbers(_KALIBR_MATRIX, (4,)).tolist()
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        terms = camera.numbers(("distortion_coeffs",), (-1,), np.zeros(4))
        table[eye] = camera.lens(matrix, terms, camera.document.get("distortion_model", ""))
    table |= _size(cameras[0], ("resolution",))
    if len(cameras) == 2:
        cam1_from_cam0 = cameras[1].numbers(("T_cn_cnm1",), (4, 4))
        table["stereo"] = _motion(cam1_from_cam0[:3, :3], unit_m * cam1_from_cam0[:3, 3])
    return _Cameras(table, [camera.place_of(_KALIBR_MATRIX) for camera in cameras])


_KALIBR_MATRIX = ("intrinsics",)
_ROS_MATRIX = ("camera_matrix", "K")
_ROS_PROJECTION = ("projection_matrix", "P")


def _ros(cameras: Sequence[_Reader], unit_m: float) -> _Cameras:
    table: dict[str, Any] = {}
    for eye, camera in zip(_CAMERAS, cameras, strict=False):
        terms = camera.numbers(("distortion_coefficients", "D"), (-1,), np.zeros(5))
        model = camera.document.get("distortion_model", "")
        table[eye] = camera.lens(camera.numbers(_ROS_MATRIX, (3, 3)), terms, model)
    table |= _size(cameras[0], ("image_width", "width"), ("image_height", "height"))
    if len(cameras) == 2:
        rotations = [_rotation(camera, ("rectification_matrix", "R")) for camera in cameras]
        projection = cameras[1].numbers(_ROS_PROJECTION, (3, 4))
        fx, x = projection[0, 0], projection[0, 3]
        if fx > 0 > x:
            right_from_rectified = rotations[1].T
            translation_m = right_from_rectified @ np.array([x / fx * unit_m, 0.0, 0.0])
            table["stereo"] = _motion(right_from_rectified @ rotations[0], translation_m)
        else:
            key = cameras[1].key(_ROS_PROJECTION) or _ROS_PROJECTION[0]
            expected = "fx above 0 and P[0, 3] = -fx * baseline, of the right camera of a calibrated pair"
            cameras[1].problem("invalid", key, f"got {short_repr(projection[0].tolist())}", expected)
    return _Cameras(table, [camera.place_of(_ROS_MATRIX) for camera in cameras])


def _spellings(*stems: str, eyes: Iterable[str]) -> tuple[str, ...]:
    """Return the names of a quantity of one camera."""
    pairs = [(stem, eye) for stem in stems for eye in eyes]
    return tuple(name for stem, eye in pairs for name in (stem + eye, eye + stem))


_MATRICES = ("M", "K", "camera_matrix", "intrinsics", "intrinsic_matrix", "mtx", "cam_matrix")
_DISTORTIONS = (
    *("D", "distortion", "distortion_coefficients", "distortion_coeffs"),
    *("dist", "dist_coeffs", "dist_coeff"),
)
_EYE_SPELLINGS: tuple[Sequence[str], ...] = (("1", "left", "l"), ("2", "right", "r"))
_NO_EYE: tuple[Sequence[str], ...] = (("",),)


def _opencv(storage: _Reader, unit_m: float) -> _Cameras:
    right = storage.key(_spellings(*_MATRICES, eyes=_EYE_SPELLINGS[1]))
    is_stereo = right is not None and isinstance(storage.document[right], dict | list)
    if float(storage.numbers(("fisheye_model",), (1,), np.zeros(1))[0]):
        storage.problem("invalid", "fisheye_model", "got a fisheye calibration", _KNOWN_MODEL)
    table: dict[str, Any] = {}
    places = []
    for eye, eyes in zip(_CAMERAS, _EYE_SPELLINGS if is_stereo else _NO_EYE, strict=False):
        names = _spellings(*_MATRICES, eyes=eyes)
        places.append(storage.place_of(names))
        matrix = storage.numbers(names, (3, 3))
        terms = storage.numbers(_spellings(*_DISTORTIONS, eyes=eyes), (-1,), np.zeros(5))
        table[eye] = storage.lens(matrix, terms, storage.document.get("distortion_model", ""))
    table |= _size(storage, ("image_size", "size", "camera_resolution", "resolution"))
    table |= {} if "width" in table else _size(storage, ("image_width", "width"), ("image_height", "height"))
    if is_stereo:
        rotation = _rotation(storage, ("R", "rotation", "rotation_matrix", "rmat"))
        translation = storage.numbers(("T", "translation", "translation_vector", "tvec"), (3,))
        table["stereo"] = _motion(rotation, unit_m * translation)
    return _Cameras(table, places)


def _size(camera: _Reader, *names: Sequence[str]) -> dict[str, float]:
    """Return width and height, from one key with both or from two keys; nothing if the document has none."""
    if not all(map(camera.has, names)):
        return {}
    shapes: Callable[[Sequence[str]], Values] = partial(camera.numbers, shape=(2,) if len(names) == 1 else (1,))
    width, height = np.concatenate([shapes(one) for one in names]).tolist()
    sides_px = {"width": width, "height": height}
    return {key: int(side_px) if side_px.is_integer() else side_px for key, side_px in sides_px.items()}


def _rotation(camera: _Reader, names: Sequence[str]) -> Values:
    """Return a rotation matrix, which the file may also hold as a rotation vector."""
    flat = camera.numbers(names, (-1,))
    return rotation_matrix(flat) if flat.size == 3 else camera.numbers(names, (3, 3))


def _motion(rotation: Values, translation_m: Values) -> dict[str, Any]:
    """Return the table of a pair's motion; a rotation that was rounded to a few digits is made exact."""
    error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if ROTATION_TOLERANCE < error <= _ROUNDED_ROTATION:
        u, _, vt = np.linalg.svd(rotation)
        rotation = u @ vt
    return {"rotation": rotation.tolist(), "translation_m": translation_m.tolist()}


def _plain(key: str) -> str:
    """Return a key without case and punctuation."""
    return re.sub("[^a-z0-9]", "", key.lower())


def _flattened(value: Any) -> Iterable[float]:
    """Yield the numbers in nested lists; NaN for anything else."""
    if isinstance(value, list | tuple):
        for item in value:
            yield from _flattened(item)
    elif isinstance(value, str):
        yield parse_number(value)
    else:
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        yield float(value) if is_number and abs(value) <= _MAX_MAGNITUDE else math.nan


def _shape_text(shape: tuple[int, ...]) -> str:
    return " x ".join("n" if side < 0 else str(side) for side in shape)
