"""Calibrations of further programs, which are recognised by their signature and refused with the remedy.

The remedy has the lines to write into ``calibration.toml``, or says where their numbers are.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

from rebar_depth_bench.base.errors import Problem
from rebar_depth_bench.base.reading import open_regular
from rebar_depth_bench.captures.fields import DISTORTION_TERMS, lens_problem

_HEAD_BYTES = 1 << 16
"""Length of the part of a file that is searched."""
_NUMBER = r"[-+]?\d{1,20}(?:\.\d{0,40})?(?:[eE][-+]?\d{1,2})?"
_ZERO = r"[-+]?0(?:\.0{0,40})?(?:[eE][-+]?\d{1,2})?"
_KEYS = (r"\bfx(?:_color)?", r"\bfy(?:_color)?", r"\b(?:cx|ppx|mx_color)", r"\b(?:cy|ppy|my_color)")
"""Keys of fx, fy, cx and cy in files that have one for each."""
_SIDES = {
    "width": rf'(?:\b|_|color)[wW]idth"?\s*[:=]\s*(\d+)|^resolution:\s*\[\s*(\d+)|^S_rect_02: ({_NUMBER})'
    r"|^\d+ [A-Z_]+ (\d+) \d+ ",
    "height": r'(?:\b|_|color)[hH]eight"?\s*[:=]\s*(\d+)|^resolution:\s*\[\s*\d+\s*,\s*(\d+)'
    rf"|^S_rect_02: \S+ ({_NUMBER})|^\d+ [A-Z_]+ \d+ (\d+) ",
}
_TERMS = (
    rf'(?:^distortion_coefficients|"coeffs")\s*:\s*\[\s*((?:{_NUMBER}[\s,]+){{3,13}}{_NUMBER})'
    r"|\bk1:\s*(\S+)\s+k2:\s*(\S+)\s+p1:\s*(\S+)\s+p2:\s*(\S+)"
)
_MODEL = r'(?:^distortion_model|^model_type|"model")\s*:\s*"?(?:distortion\.)?(?!PINHOLE)([\w-]+)'


@dataclass(frozen=True)
class _Signature:
    """File of another program: its pattern and, if fx fy cx cy are in a list, its start and their ``places``.

    A fifth place is that of fx times the offset of a camera. Of a pair, EYE in ``start`` is one of ``eyes``.
    ``model`` and ``terms`` are patterns of the lens; ``first_pixel`` is the centre of the first pixel.
    """

    title: str
    pattern: str
    start: str = ""
    places: tuple[int, ...] = (0, 1, 2, 3)
    remark: str = ""
    model: str = _MODEL
    terms: str = _TERMS
    eyes: tuple[str, ...] = ("",)
    first_pixel: float = 0.0


def _colmap(models: str, *places: int) -> _Signature:
    """Return the signature of COLMAP's cameras of some models, whose parameters have fx fy cx cy at ``places``."""
    start = rf"^\d+ (?:{models}) \d+ \d+ "
    terms = rf"{start}(?:{_NUMBER} ){{{places[3]}}}{_NUMBER}((?: {_NUMBER})+)"
    return _Signature(
        "COLMAP's cameras.txt", start, start, places, "its first camera", "(?!)", terms, first_pixel=0.5
    )


_SIGNATURES = (
    _Signature(
        *("EuRoC's sensor.yaml", r"^T_BS:", r"^intrinsics:\s*\["),
        remark="one camera; of a pair, x_right = inv(T_BS of cam1) @ T_BS of cam0 @ x_left is for [stereo]",
    ),
    _Signature(
        "Open3D's intrinsic.json, whose matrix is a list of columns",
        rf'"intrinsic_matrix"\s*:\s*\[\s*{_NUMBER}\s*,\s*{_ZERO}\s*,\s*{_ZERO}\s*,',
        *(r'"intrinsic_matrix"\s*:\s*\[', (0, 4, 6, 7)),
    ),
    _Signature("RealSense's intrinsics", r'"ppx"\s*:'),
    _Signature(
        *("DepthAI's calibration, whose lenses have 14 terms", r'"cameraData"\s*:'),
        remark="the cameras of rectified pictures: K of the right one for their size (getCameraIntrinsics) in "
        "[left] and [right], zero distortion, and baseline_m from getBaselineDistance(), which is in centimetres",
    ),
    _Signature("a camera of camodocal or VINS", r"^projection_parameters:"),
    _Signature("ScanNet's scene file", r"^fx_color\s*="),
    _Signature(
        "a matrix as text, such as ScanNet's intrinsic_color.txt",
        rf"\A\s*(?:{_NUMBER}\s+){{8}}{_ZERO}\s+{_ZERO}\s+{_NUMBER}\s+{_ZERO}\s+(?:{_ZERO}\s+){{3}}{_NUMBER}\s*\Z",
        *(r"\A\s*", (0, 5, 2, 6)),
    ),
    _Signature(
        *("a file of TUM's RGB-D data set", r"\A# (?:color images|depth maps|ground truth trajectory)\s"),
        remark='the numbers under "intrinsic camera calibration" on the page of the data set',
    ),
    _Signature(
        "TUM's camera.txt, whose lens model is FOV",
        rf"\A\s*(?:{_NUMBER}[ \t]+){{4}}{_NUMBER}\s*\n\d+\s+\d+\s*\n",
        model=r"\A()",
    ),
    _Signature(
        *("KITTI's calibration", r"^P(?:_rect_0)?2: ", r"^P(?:_rect_0)?EYE: ", (0, 5, 2, 6, 3)),
        remark="the numbers of image_2 and image_3; for one camera leave out [right] and [stereo]",
        eyes=("2", "3"),
    ),
    _colmap("PINHOLE|OPENCV|FULL_OPENCV", 0, 1, 2, 3),
    _colmap("SIMPLE_PINHOLE|SIMPLE_RADIAL|RADIAL", 0, 0, 1, 2),
    _Signature("COLMAP's cameras.txt", r"^\d+ [A-Z_]+ \d+ \d+ |\A# Camera list", model=r"^\d+ ([A-Z_]+) \d+ \d+ "),
    _Signature(
        "COLMAP's cameras.bin",
        r"\A[^\0][\s\S]{3}\0{4}[\s\S]{4}[\0-\x20]\0{3}[\s\S]{4}\0{4}[\s\S]{4}\0{4}",
        remark="the numbers of cameras.txt, which colmap model_converter --output_type TXT writes",
    ),
    _Signature(
        *("HDF5, as BlenderProc writes it", r"\A\x89HDF\r\n\x1a\n"),
        remark="K = bproc.camera.get_intrinsics_as_K_matrix() in [left]; or BlenderProc's write_bop, whose "
        "scene_camera.json rebar-build import reads",
    ),
)


def recognised_problem(path: Path) -> Problem | None:
    """Return the problem of a file with a known signature, which has the remedy; None for any other file."""
    try:
        with open_regular(path) as stream:
            text = stream.read(_HEAD_BYTES).removeprefix(b"\xef\xbb\xbf").decode("latin-1")
    except OSError:
        return None
    lines = text if text.startswith("\x89") else text.replace("\r\n", "\n")
    seen = (one for one in _SIGNATURES if re.search(one.pattern, lines, re.MULTILINE))
    return next((_problem(path.name, lines, signature) for signature in seen), None)


def _problem(name: str, text: str, signature: _Signature) -> Problem:
    found, remark = f"is {signature.title}", signature.remark
    terms = _numbers(signature.terms, text)
    terms += [0.0] * (DISTORTION_TERMS - len(terms) if len(terms) < 4 else 0)
    model = re.search(signature.model, text, re.MULTILINE)
    lens = lens_problem(name, {"the lens model": "radtan" if model is None else model[1] or "FOV"}, terms)
    if lens is not None:
        return replace(lens, found=f"{found}; {lens.found}")
    cameras = [_pinhole(text, signature, eye) for eye in signature.eyes]
    if not all(cameras):
        return Problem(
            "unknown", name, found, f"calibration.toml with {remark or 'fx, fy, cx and cy of the camera'}"
        )
    sides = {key: _numbers(pattern, text) for key, pattern in _SIDES.items()}
    lines = ["calibration.toml with these lines:", *([f"# {remark}"] if remark else [])]
    lines += [f"{key} = {values[0]:.0f}" for key, values in sides.items() if values]
    for eye, (fx, fy, cx, cy, *_) in zip(("left", "right"), cameras, strict=False):
        lines += [f"[{eye}]", f"fx = {fx}", f"fy = {fy}"]
        lines += [f"cx = {cx - signature.first_pixel}", f"cy = {cy - signature.first_pixel}"]
        lines.append(f"distortion = {[*terms, 0.0][:DISTORTION_TERMS]}")
    if len(cameras) == 2:
        x_left_m, x_right_m = (camera[4] / camera[0] for camera in cameras)
        lines += ["[stereo]", "rotation = [0, 0, 0]", f"baseline_m = {x_left_m - x_right_m}"]
    return Problem("unknown", name, found, "\n    ".join(lines))


def _pinhole(text: str, signature: _Signature, eye: str) -> list[float]:
    """Return the numbers of one camera, of which fx is above 0; none if they are damaged."""
    if signature.start:
        start = signature.start.replace("EYE", eye)
        numbers = _numbers(rf"{start}\s*((?:{_NUMBER}[\s,]+)*{_NUMBER})", text)
        pinhole = [numbers[place] for place in signature.places] if len(numbers) > max(signature.places) else []
    else:
        pinhole = [number for key in _KEYS for number in _numbers(rf'{key}"?\s*[:=]\s*({_NUMBER})', text)]
    return pinhole if len(pinhole) >= 4 and pinhole[0] > 0 else []


def _numbers(pattern: str, text: str) -> list[float]:
    """Return the numbers in the groups of a pattern; none if it is not in the text."""
    match = re.search(pattern, text, re.MULTILINE)
    groups = [] if match is None else [group for group in match.groups() if group]
    return [float(word) for word in re.findall(_NUMBER, " ".join(groups))]
