"""Calibrations of further programs, which are recognised by their signature and refused with the remedy.

The remedy has the lines to write into ``calibration.toml``, or says where their numbers are.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from rebar_depth_bench.base.errors import Problem
from rebar_depth_bench.base.reading import open_regular
from rebar_depth_bench.captures.fields import DISTORTION_TERMS, lens_problem

_HEAD_BYTES = 1 << 16
"""Length of the part of a file that is searched."""
_NUMBER = r"[-+]?(?:\d{1,20}(?:\.\d{0,40})?|\.\d{1,40})(?:[eE][-+]?\d{1,3})?"
_ZERO = r"[-+]?0(?:\.0{0,40})?(?:[eE][-+]?\d{1,2})?"
_ENTRY = (
    rf'(?:^(?:\d+ )?|[\s"])([A-Za-z_]\w*)(?: |"?\s*[:=]\s*(?:\[\s*)?)((?:{_NUMBER}[\s,]+)*{_NUMBER})(?! ?[\w.])'
)
"""Key and its numbers, up to the end of a line or list; none if another word follows."""
_COLMAP = "COLMAP's cameras.txt"
_MODEL = r"^distortion_model:\s*([\w-]+)|^\d+ (FOV|\w+_FISHEYE) "


@dataclass(frozen=True)
class _Program:
    """File of a program: a pattern of its name and text, where its numbers are, and a remark.

    ``camera`` names fx fy cx cy, and ``size`` width and height, each by a key and places in its list.
    The distortion begins at the first place of ``terms``. Of a pair, ``offsets`` are fx times the offset of each
    camera. ``first_pixel`` is the centre of the first pixel.
    """

    title: str
    pattern: str
    remark: str = ""
    camera: str = ""
    size: str = ""
    terms: str = ""
    offsets: str = ""
    first_pixel: float = 0.0


def _kitti(key: str) -> _Program:
    remark = "the numbers of image_2 and image_3; for one camera leave out [right] and [stereo]"
    camera, offsets = f"{key}2:0,5,2,6", f"{key}2:3 {key}3:3"
    return _Program("KITTI's calibration", rf"^{key}2: ", remark, camera, "S_rect_02:0,1", offsets=offsets)


def _colmap(model: str, camera: str, terms: str) -> _Program:
    pattern, (camera, size, terms) = rf"^\d+ {model} ", (f"{model}:{text}" for text in (camera, "0,1", terms))
    return _Program(_COLMAP, pattern, f"its first {model} camera", camera, size, terms, first_pixel=0.5)


_PROGRAMS = (
    _Program(
        *("EuRoC's sensor.yaml", r"^T_BS:"),
        "one camera; of a pair, x_right = inv(T_BS of cam1) @ T_BS of cam0 @ x_left is for [stereo]",
        *("intrinsics:0,1,2,3", "resolution:0,1", "distortion_coefficients:0"),
    ),
    _Program(
        "intrinsic.json of Open3D or RealSense, whose matrix is a list of columns",
        rf'"intrinsic_matrix"\s*:\s*\[\s*{_NUMBER}\s*,\s*{_ZERO}\s*,\s*{_ZERO}\s*,',
        *("in pixels", "intrinsic_matrix:0,4,6,7", "width:0 height:0"),
    ),
    _Program(
        *("DepthAI's calibration, whose lenses have 14 terms", r'"cameraData"\s*:'),
        "the cameras of rectified pictures: K of the right one for their size (getCameraIntrinsics) in [left] and "
        "[right], zero distortion, and baseline_m from getBaselineDistance(), which is in centimetres",
    ),
    _Program(
        *("ScanNet's scene file", r"^fx_color\s*=", "the colour camera"),
        *("fx_color:0 fy_color:0 mx_color:0 my_color:0", "colorWidth:0 colorHeight:0"),
    ),
    _Program(
        "a matrix as text, such as ScanNet's intrinsic_color.txt",
        rf"\A.*\n\s*(?:{_NUMBER}\s+){{8}}(?:{_ZERO}\s+){{2}}{_NUMBER}\s+(?:{_ZERO}\s+){{4}}{_NUMBER}\s*\Z",
        *("in pixels", "matrix:0,5,2,6"),
    ),
    _Program(
        *("a file of TUM's RGB-D data set", r"^# (?:color images|depth maps|ground truth trajectory)$"),
        'the numbers under "intrinsic camera calibration" on the page of the data set',
    ),
    _Program(
        "TUM's camera.txt, whose lens model is FOV",
        rf"\A.*\n(?:{_NUMBER}[ \t]+){{4}}{_NUMBER}\s*\n\d+\s+\d+\s*\n",
        "zero distortion and the new K that its own tool prints, after it rectified the images",
    ),
    _kitti("P"),
    _kitti("P_rect_0"),
    *(_colmap(model, "2,3,4,5", "6") for model in ("PINHOLE", "OPENCV", "FULL_OPENCV")),
    *(_colmap(model, "2,2,3,4", "5") for model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")),
    _Program(_COLMAP, r"^\d+ [A-Z_]+ \d+ \d+ |^# Camera list", "its first camera"),
    _Program(
        *("COLMAP's cameras.bin", r"\Acameras\.bin\n"),
        "the numbers of cameras.txt, which colmap model_converter --output_type TXT writes",
    ),
    _Program(
        *("HDF5, as BlenderProc writes it", r"\A.*\n\x89HDF"),
        "K = bproc.camera.get_intrinsics_as_K_matrix() in [left]; or BlenderProc's write_bop, whose "
        "scene_camera.json rebar-build import reads",
    ),
)


def recognised_problem(path: Path) -> Problem | None:
    """Return the problem of a file with a known signature, which has the remedy; None for any other file."""
    try:
        with open_regular(path) as stream:
            text = stream.read(_HEAD_BYTES).removeprefix(b"\xef\xbb\xbf").decode("latin-1").replace("\r\n", "\n")
    except OSError:
        return None
    named = f"{path.name}\n{text}"
    seen = (program for program in _PROGRAMS if re.search(program.pattern, named, re.MULTILINE))
    return next((_problem(path.name, text, program) for program in seen), None)


def _problem(name: str, text: str, program: _Program) -> Problem:
    values: dict[str, list[str]] = {}
    for key, numbers in re.findall(_ENTRY, f"matrix {text.lstrip()}", re.MULTILINE):
        values.setdefault(key, re.findall(_NUMBER, numbers))
    key, _, first = program.terms.partition(":")
    terms = [float(word) for word in values.get(key, [])[int(first or 0) :]]
    terms += [0.0] * (DISTORTION_TERMS - len(terms) if len(terms) < 4 else 0)
    model = re.search(_MODEL, text, re.MULTILINE)
    found = f"is {program.title}"
    lens = lens_problem(name, {"the lens model": model[1] or model[2] if model else "radtan"}, terms)
    if lens is not None:
        return replace(lens, found=f"{found}; {lens.found}")
    pinhole, size = _numbers(values, program.camera), _numbers(values, program.size)
    if not pinhole or pinhole[0] <= 0:
        return Problem("unknown", name, found, f"calibration.toml with {program.remark}")
    lines = ["calibration.toml with these lines:", f"# {program.remark}"]
    lines += [f"{key} = {side:.0f}" for key, side in zip(("width", "height"), size, strict=False)]
    for eye in ("left", "right") if program.offsets else ("left",):
        lines += [f"[{eye}]", f"fx = {pinhole[0]}", f"fy = {pinhole[1]}"]
        lines += [
            f"c{axis} = {value - program.first_pixel}" for axis, value in zip("xy", pinhole[2:], strict=True)
        ]
        lines.append(f"distortion = {[*terms, 0.0][:DISTORTION_TERMS]}")
    if offsets := _numbers(values, program.offsets):
        baseline_m = (offsets[0] - offsets[1]) / pinhole[0]
        lines += ["[stereo]", "rotation = [0, 0, 0]", f"baseline_m = {baseline_m}"]
    return Problem("unknown", name, found, "\n    ".join(lines))


def _numbers(values: Mapping[str, list[str]], places: str) -> list[float]:
    """Return the numbers at ``places``, such as ``K:0,4 width:0``; none if one is missing."""
    numbers = []
    for key, _, indices in (part.partition(":") for part in places.split()):
        numbers += [float(word) for index in indices.split(",") for word in values.get(key, [])[int(index) :][:1]]
    return numbers if len(numbers) == places.count(":") + places.count(",") else []
