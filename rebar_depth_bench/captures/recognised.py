"""Calibrations of further programs, which are recognised by their signature and refused with the remedy.

The remedy has the lines to write into ``calibration.toml``, or says where their numbers are.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from rebar_depth_bench.base.errors import Problem
from rebar_depth_bench.base.reading import open_regular
from rebar_depth_bench.captures.fields import DISTORTION_TERMS, lens_problem

_HEAD_BYTES = 1 << 16
"""Length of the part of a file that is searched."""
_NUMBER = r"[-+]?\d{1,20}(?:\.\d{0,40})?(?:[eE][-+]?\d{1,2})?"
_ZERO = r"[-+]?0(?:\.0{0,40})?(?:[eE][-+]?\d{1,2})?"
_PINHOLE = ("fx", "fy", "cx", "cy")


@dataclass(frozen=True)
class _Signature:
    """File of another program: its pattern, the patterns of numbers in it, and a remark.

    ``numbers`` are those of fx, fy, cx, cy, and as far as they are known of width, height, the terms of distortion
    and tx, which is fx times the offset of a camera. ``model`` is that of the lens model, radtan if none is found,
    or its name. Of a pair, EYE in patterns is one of ``eyes``. ``first_pixel`` is the centre of the first pixel.
    """

    title: str
    pattern: str
    numbers: Mapping[str, str] = field(default_factory=dict)
    model: str = "radtan"
    remark: str = ""
    eyes: tuple[str, ...] = ("",)
    first_pixel: float = 0.0


def _nth(start: str, *indices: int) -> dict[str, str]:
    """Return the patterns of fx, fy, cx, cy and perhaps tx, at ``indices`` of the numbers after ``start``."""
    between = rf"{start}\s*(?:{_NUMBER}[\s,]+)"
    return {
        key: rf"{between}{{{index}}}({_NUMBER})" for key, index in zip((*_PINHOLE, "tx"), indices, strict=False)
    }


def _key(key: str) -> str:
    """Return the pattern of a number that follows a key."""
    return rf"\b{key}\"?\s*[:=]\s*({_NUMBER})"


def _terms(start: str) -> str:
    """Return the pattern of all numbers in a list after ``start``."""
    return rf"{start}\s*((?:{_NUMBER}[\s,]+){{3,13}}{_NUMBER})"


_COLMAP = r"^\d+ EYE \d+ \d+ "
_SIGNATURES = (
    _Signature(
        "EuRoC's sensor.yaml",
        r"^T_BS:",
        _nth(r"^intrinsics:\s*\[", 0, 1, 2, 3)
        | {"terms": _terms(r"^distortion_coefficients:\s*\["), "width": r"^resolution:\s*\[\s*(\d+)"}
        | {"height": r"^resolution:\s*\[\s*\d+\s*,\s*(\d+)"},
        r"^distortion_model:\s*([\w-]+)",
        "one camera; of a pair, x_right = inv(T_BS of cam1) @ T_BS of cam0 @ x_left is for [stereo]",
    ),
    _Signature(
        "Open3D's intrinsic.json, whose matrix is a list of columns",
        rf'"intrinsic_matrix"\s*:\s*\[\s*{_NUMBER}\s*,\s*{_ZERO}\s*,\s*{_ZERO}\s*,',
        _nth(r'"intrinsic_matrix"\s*:\s*\[', 0, 4, 6, 7) | {"width": _key("width"), "height": _key("height")},
    ),
    _Signature(
        "RealSense's intrinsics",
        r'"ppx"\s*:',
        {"fx": _key("fx"), "fy": _key("fy"), "cx": _key("ppx"), "cy": _key("ppy"), "width": _key("width")}
        | {"height": _key("height"), "terms": _terms(r'"coeffs"\s*:\s*\[')},
        r'"model"\s*:\s*"(?:distortion\.)?(\w+)"',
    ),
    _Signature(
        "DepthAI's calibration, whose lenses have 14 terms",
        r'"cameraData"\s*:',
        remark="the cameras of rectified pictures: K of the right one for their size (getCameraIntrinsics) in "
        "[left] and [right], zero distortion, and baseline_m from getBaselineDistance(), which is in centimetres",
    ),
    _Signature(
        "a camera of camodocal or VINS",
        r"^projection_parameters:",
        {key: _key(key) for key in _PINHOLE}
        | {"terms": r"\bk1:\s*(\S+)\s+k2:\s*(\S+)\s+p1:\s*(\S+)\s+p2:\s*(\S+)"}
        | {"width": _key("image_width"), "height": _key("image_height")},
        r"^model_type:\s*(?!PINHOLE)(\w+)",
    ),
    _Signature(
        "ScanNet's scene file",
        r"^fx_color\s*=",
        {"fx": _key("fx_color"), "fy": _key("fy_color"), "cx": _key("mx_color"), "cy": _key("my_color")}
        | {"width": _key("colorWidth"), "height": _key("colorHeight")},
    ),
    _Signature(
        "a matrix as text, such as ScanNet's intrinsic_color.txt",
        rf"\A\s*(?:{_NUMBER}\s+){{8}}{_ZERO}\s+{_ZERO}\s+{_NUMBER}\s+{_ZERO}\s+(?:{_ZERO}\s+){{3}}{_NUMBER}\s*\Z",
        _nth(r"\A", 0, 5, 2, 6),
    ),
    _Signature(
        "a matrix as text",
        rf"\A\s*(?:{_NUMBER}\s+){{6}}{_ZERO}\s+{_ZERO}\s+{_NUMBER}\s*\Z",
        _nth(r"\A", 0, 4, 2, 5),
    ),
    _Signature(
        "a file of TUM's RGB-D data set",
        r"\A# (?:color images|depth maps|ground truth trajectory)\s",
        remark='the numbers under "intrinsic camera calibration" on the page of the data set',
    ),
    _Signature("TUM's camera.txt", rf"\A\s*(?:{_NUMBER}[ \t]+){{4}}{_NUMBER}\s*\n\d+\s+\d+\s*\n", model="FOV"),
    _Signature(
        "TUM's (DSO) camera.txt",
        rf"\A\s*[A-Za-z]+(?:[ \t]+{_NUMBER}){{5,8}}\s*\n\d+\s+\d+\s*\n",
        _nth(r"\A\s*[A-Za-z]+", 0, 1, 2, 3)
        | {"terms": rf"\A\s*RadTan(?:\s+{_NUMBER}){{4}}((?:\s+{_NUMBER}){{4}})"}
        | {"width": r"\A.*\n(\d+)\s", "height": r"\A.*\n\d+\s+(\d+)\s"},
        r"\A\s*([A-Za-z]+)",
    ),
    _Signature(
        "KITTI's calibration",
        r"^P(?:_rect_0)?2: ",
        _nth(r"^P(?:_rect_0)?EYE:", 0, 5, 2, 6, 3)
        | {"width": rf"^S_rect_02:\s*({_NUMBER})", "height": rf"^S_rect_02:\s*{_NUMBER}\s+({_NUMBER})"},
        remark="the numbers of image_2 and image_3; for one camera leave out [right] and [stereo]",
        eyes=("2", "3"),
    ),
    *(
        _Signature(
            "COLMAP's cameras.txt",
            _COLMAP.replace("EYE", names),
            _nth(_COLMAP.replace("EYE", names), *indices)
            | {"terms": rf"{_COLMAP.replace('EYE', names)}(?:{_NUMBER} ){{{indices[3]}}}{_NUMBER}( .+)"}
            | {"width": rf"^\d+ {names} (\d+)", "height": rf"^\d+ {names} \d+ (\d+)"},
            remark="the first camera of the file",
            first_pixel=0.5,
        )
        for names, indices in (
            ("(?:PINHOLE|OPENCV|FULL_OPENCV)", (0, 1, 2, 3)),
            ("(?:SIMPLE_PINHOLE|SIMPLE_RADIAL|RADIAL)", (0, 0, 1, 2)),
        )
    ),
    _Signature("COLMAP's cameras.txt", r"^\d+ [A-Z_]+ \d+ \d+ |\A# Camera list", model=r"^\d+ ([A-Z_]+) \d+ \d+ "),
    _Signature(
        "COLMAP's cameras.bin",
        r"\A[^\0][\s\S]{3}\0{4}[\s\S]{4}[\0-\x20]\0{3}[\s\S]{4}\0{4}[\s\S]{4}\0{4}",
        remark="the numbers of cameras.txt, which colmap model_converter --output_type TXT writes",
    ),
    _Signature(
        "HDF5, as BlenderProc writes it",
        r"\A\x89HDF\r\n\x1a\n",
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
    if not text.startswith("\x89"):
        text = text.replace("\r\n", "\n")
    for signature in _SIGNATURES:
        if re.search(signature.pattern, text, re.MULTILINE):
            return _problem(path.name, text, signature)
    return None


def _problem(name: str, text: str, signature: _Signature) -> Problem:
    found, remark, model = f"is {signature.title}", signature.remark, signature.model
    left, *right = cameras = [_numbers(text, signature, eye) for eye in signature.eyes]
    terms = left.get("terms", [])
    terms = [*terms, *[0.0] * (DISTORTION_TERMS - len(terms))] if len(terms) < 4 else terms
    if "(" in model:
        match = re.search(model, text, re.MULTILINE)
        model = match[1] if match else "radtan"
    lens = lens_problem(name, {"the lens model": model}, terms)
    if lens is not None:
        return replace(lens, found=f"{found}; {lens.found}")
    keys = (*_PINHOLE, *(["tx"] if right else []))
    if not all(key in numbers and numbers["fx"][0] > 0 for numbers in cameras for key in keys):
        return Problem(
            "unknown", name, found, f"calibration.toml with {remark or 'fx, fy, cx and cy of the camera'}"
        )
    lines = ["calibration.toml with these lines:", *([f"# {remark}"] if remark else [])]
    lines += [f"{key} = {left[key][0]:.0f}" for key in ("width", "height") if key in left]
    for eye, numbers in zip(("left", "right"), cameras, strict=False):
        fx, fy, cx, cy = (numbers[key][0] for key in _PINHOLE)
        lines += [f"[{eye}]", f"fx = {fx}", f"fy = {fy}"]
        lines += [f"cx = {cx - signature.first_pixel}", f"cy = {cy - signature.first_pixel}"]
        lines.append(f"distortion = {[*terms, 0.0][:DISTORTION_TERMS]}")
    if right:
        x_left_m, x_right_m = (numbers["tx"][0] / numbers["fx"][0] for numbers in cameras)
        lines += ["[stereo]", "rotation = [0, 0, 0]", f"baseline_m = {x_left_m - x_right_m}"]
    return Problem("unknown", name, found, "\n    ".join(lines))


def _numbers(text: str, signature: _Signature, eye: str) -> dict[str, list[float]]:
    """Return the numbers of one camera that a text has."""
    numbers = {}
    for key, pattern in signature.numbers.items():
        match = re.search(pattern.replace("EYE", eye), text, re.MULTILINE)
        if match is not None:
            numbers[key] = [float(word) for word in re.findall(_NUMBER, " ".join(match.groups()))]
    return numbers
