"""Stereo calibration files: Stereolabs ``.conf`` or TOML, scaled to the requested image size."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Literal

from rebar_depth_bench.base.errors import MAX_PROBLEMS_SHOWN, CalibrationError, Problem, escape_text
from rebar_depth_bench.base.limits import TOML_BYTES
from rebar_depth_bench.base.reading import decode_text, parse_number, parse_toml, read_file
from rebar_depth_bench.base.validation import Expected, format_location, short_repr
from rebar_depth_bench.captures.calibration import (
    ANGLE_RAD,
    DISTORTION,
    FOCAL_PX,
    SIDES_PX,
    Calibration,
    Lens,
    StereoCalibration,
    principal_point,
    quantity,
    scaled_calibration,
    table_calibration,
)
from rebar_depth_bench.captures.fields import DISTORTION_TERMS, LENS_TERMS, Field, FileFormat, lens_problem


def read_calibration(path: str | Path, width: int, height: int) -> StereoCalibration:
    """Read a stereo calibration from a ``.conf`` or ``.toml`` file, for images of ``width`` x ``height`` pixels.

    ``.conf`` is Stereolabs' INI file, whose keys docs/formats.md lists: sections ``LEFT_CAM_X``, ``RIGHT_CAM_X``
    for each image size X, such as HD, and ``STEREO``. If the file has no sections for the requested size, those
    nearest in aspect ratio and then in width are read and passed to ``scale_calibration``, which assumes that both
    sizes cover the same sensor area; a file that shows that they do not, or has sections of unknown sizes, is
    refused. The motion is ``x_right = R x_left + T`` with R = Rodrigues(RX, CV, RZ) and T = -(Baseline, TY, TZ):
    the whole vector is negated, which keeps it on the line that the vendor's rectification uses.

    In TOML, ``K = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]`` may replace the four numbers, ``rotation`` may be a
    3 x 3 matrix, and ``baseline_m = 0.12`` may replace ``translation_m = [-0.12, 0, 0]``::

        width = 1280    # image size of the calibration; default: the requested size
        height = 720

        [left]
        fx = 701.88
        fy = 701.70
        cx = 641.285    # pixel centres at integers
        cy = 344.1835
        distortion = [-0.175286, 0.0283094, 6.68e-5, -1.50e-4, 1e-10]    # k1 k2 p1 p2, and k3 if known

        [right]
        K = [[700.965, 0, 633.515], [0, 701.11, 359.3135], [0, 0, 1]]
        distortion = [-0.172795, 0.0265223, 1.64e-4, 1.02e-5]

        [stereo]        # x_right = R x_left + T
        rotation = [-9.17e-4, 6.24e-3, 7.70e-4]    # Rodrigues vector, radians
        translation_m = [-0.119978, 0.0, 0.0]

    Raises ``CalibrationError`` with all problems of the file; also if a distortion model cannot be inverted over
    the whole image, if the requested size is not 16 to 16384 pixels each, and if its aspect ratio is another one.
    """
    calibration = own_calibration(Path(path), width, height, is_stereo=True)
    assert isinstance(calibration, StereoCalibration)
    return calibration


def own_calibration(path: Path, width: int, height: int, *, is_stereo: bool) -> Calibration:
    """Return the calibration in a file as ``read_calibration``; a ``.toml`` file may have one camera."""
    suffix = path.suffix.lower()
    if suffix not in (".conf", ".toml"):
        problem = Problem("invalid", "", f"the file suffix is {path.suffix!r}", ".conf or .toml")
        raise CalibrationError.from_problems(path, [problem])
    content = read_file(path, TOML_BYTES, "a calibration file", CalibrationError)
    check_image_size(path, width, height)
    problems: list[Problem] = []
    if suffix == ".conf":
        calibration: Calibration | None = _read_conf(path.name, content, width, height, problems)
    else:
        document, problems = parse_toml(content)
        is_pair = is_stereo or "right" in document
        calibration = None if problems else table_calibration(document, width, height, problems, is_stereo=is_pair)
    if calibration is None:
        raise CalibrationError.from_problems(path, problems)
    return scaled_calibration(calibration, path, width, height)


def check_image_size(path: object, width: int, height: int) -> None:
    """Raise ``CalibrationError`` for images of a size that the calibration ``path`` cannot be scaled to."""
    if width not in SIDES_PX or height not in SIDES_PX:
        expected = f"{SIDES_PX[0]} to {SIDES_PX[-1]} pixels each"
        problem = Problem("invalid", "", f"it is requested for images of {width} x {height}", expected)
        raise CalibrationError.from_problems(path, [problem])


# Stereolabs' files, an INI format.

_GRIDS: Mapping[str, tuple[int, int]] = {
    "2K": (2208, 1242),
    "FHD": (1920, 1080),
    "FHD1200": (1920, 1200),
    "HD": (1280, 720),
    "SVGA": (960, 600),
    "VGA": (672, 376),
    "4K": (3840, 2160),
    "QHDPLUS": (3200, 1800),
    "HD1536": (1920, 1536),
    "XVGA": (960, 768),
    "TXGA": (640, 512),
}
"""Image sizes (width, height) of Stereolabs cameras, pixels, by section suffix."""
_CAMERAS = ("LEFT_CAM_", "RIGHT_CAM_")

_TERMS = (*LENS_TERMS, "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY")
"""Distortion terms in OpenCV's order."""
_STEREO: Mapping[str, Expected] = {
    "Baseline": quantity(1, 10_000, "millimetres"),
    **dict.fromkeys(("TY", "TZ"), quantity(-1000, 1000, "millimetres")),
    **dict.fromkeys(("RX", "CV", "RZ"), ANGLE_RAD),
}
_OPTIONAL = (*_TERMS[2:], "TY", "TZ")
"""Fields that may be missing, which means 0."""


def _fields(names: Iterable[str], keys: str, use: Literal["used", "checked"], meaning: str) -> list[Field]:
    return [Field(name, tuple(keys.replace("#", name).split()), use, meaning) for name in names]


_SIZES = ", ".join(f"{name} ({width} x {height})" for name, (width, height) in _GRIDS.items())
_DISTO = "EYE_DISTO.# EYE_CAM_X.#"
ZED_CONF = FileFormat(
    "Stereolabs' `*.conf`",
    (
        *_fields(("fx", "fy", "cx", "cy"), "EYE_CAM_X.#", "used", f"pixels; EYE: LEFT or RIGHT; X: {_SIZES}"),
        *_fields(LENS_TERMS, _DISTO, "used", "distortion; equal if in both sections"),
        *_fields(_TERMS[DISTORTION_TERMS:], _DISTO, "checked", "absent or 0: terms of other lens models"),
        *_fields(("Baseline", "TY", "TZ"), "STEREO.#_X STEREO.#", "used", "T = -(Baseline, TY, TZ), millimetres"),
        *_fields(("RX", "CV", "RZ"), "STEREO.#_X STEREO.#", "used", "R = Rodrigues(RX, CV, RZ), radians"),
        Field("miscellaneous", ("MISC",), "harmless", "such as the kind of sensor"),
    ),
)
"""Fields by section and key, in which EYE and X stand for the names of an eye and of an image size."""

_Sections = Mapping[str, Mapping[str, tuple[int, str]]]
"""Line and text of each key of each section."""
_COMMENT = re.compile(r"(?:^|\s)[;#]")
_SEPARATOR = re.compile("[=:]")


def _lens(sections: _Sections, eye: str, suffix: str, problems: list[Problem]) -> Lens:
    """Return the lens of the camera ``eye`` for an image size; problems are added to ``problems``."""
    width, height = _GRIDS[suffix]
    pinhole = {"fx": FOCAL_PX, "fy": FOCAL_PX, "cx": principal_point(width), "cy": principal_point(height)}
    fx, fy, cx, cy = _numbers(sections, pinhole, eye, suffix, problems)
    invalid = list[Problem]()
    terms = _numbers(sections, dict.fromkeys(_TERMS, DISTORTION), eye, suffix, invalid)
    while terms[5:] and not terms[-1]:
        terms.pop()
    present = [name for name in _TERMS if _entries(sections, name, eye, suffix)]
    has_four = "k4" in present and "p1" not in present and "p2" not in present
    models = {"the lens model": "fisheye, k1 k2 k3 k4"} if has_four else {}
    section = f"{eye}_DISTO" if f"{eye}_DISTO" in sections else f"{eye}_CAM_{suffix}"
    problem = lens_problem(section, models, terms)
    problems += invalid if problem is None else [problem]
    return Lens(fx, fy, cx, cy, (terms[0], terms[1], terms[2], terms[3], terms[4]))


def _numbers(
    sections: _Sections, fields: Mapping[str, Expected], eye: str, suffix: str, problems: list[Problem]
) -> list[float]:
    """Return the numbers of fields; 0 and a problem for an invalid one, and for a missing one of a section."""
    numbers = []
    for name, expected in fields.items():
        entries = _entries(sections, name, eye, suffix)
        place, line, raw = (*entries, (_place(ZED_CONF.keys(name)[-1], eye, suffix), 0, "0"))[0]
        numbers.append(parse_number(raw))
        if not entries and place.partition(".")[0] in sections and name not in _OPTIONAL:
            problems.append(Problem("missing", place, "missing", expected.text))
        elif entries and not expected.accept(numbers[-1]):
            problems.append(Problem("invalid", place, f"line {line}: got {short_repr(raw)}", expected.text))
        elif name in _TERMS and any(parse_number(other) != numbers[-1] for _, _, other in entries[1:]):
            problems.append(Problem("conflict", place, f"differs from {entries[1][0]}", "one lens model"))
    return numbers


def _entries(sections: _Sections, name: str, eye: str, suffix: str) -> list[tuple[str, int, str]]:
    """Return place, line and text of the keys of a field that the file has."""
    places = [_place(key, eye, suffix).split(".") for key in ZED_CONF.keys(name)]
    return [
        (f"{section}.{key}", *sections[section][key.lower()])
        for section, key in places
        if key.lower() in sections.get(section, {})
    ]


def _place(key: str, eye: str, suffix: str) -> str:
    """Return a key of the table for one camera and one image size."""
    return key.replace("EYE", eye).replace("_X", f"_{suffix}")


def _read_conf(
    name: str, content: bytes, width: int, height: int, problems: list[Problem]
) -> StereoCalibration | None:
    """Return the calibration of a Stereolabs ``.conf`` file for one of its image sizes; the caller scales it.

    The size is that nearest to ``width`` x ``height`` in aspect ratio, then in width. Section names and keys are
    case-insensitive. Problems are added to ``problems``; the result is None if there are any.
    """
    sections = _read_sections(content, problems)
    suffix = _nearest_suffix(sections, width, height, problems)
    if suffix is None:
        return None
    names = (f"LEFT_CAM_{suffix}", f"RIGHT_CAM_{suffix}", "STEREO")
    problems += [Problem("missing", one, "missing", "a section") for one in names if one not in sections]
    left, right = (_lens(sections, eye, suffix, problems) for eye in ("LEFT", "RIGHT"))
    baseline_mm, y_mm, z_mm, rx, cv, rz = _numbers(sections, _STEREO, "", suffix, problems)
    translation_m = (0.0 - baseline_mm / 1000, 0.0 - y_mm / 1000, 0.0 - z_mm / 1000)
    if problems:
        return None
    notes = _notes(name, sections)
    if _GRIDS[suffix] != (width, height):
        size = " x ".join(map(str, _GRIDS[suffix]))
        notes.append(f"{name}: scaled from {suffix}, {size}, as if both sizes showed the same part of the sensor")
    return StereoCalibration(*_GRIDS[suffix], left, right, (rx, cv, rz), translation_m, tuple(notes))


def _notes(name: str, sections: _Sections) -> list[str]:
    """Return the note that names the sections, and the keys of known ones, that ``ZED_CONF`` does not list."""
    keys = [key for field in ZED_CONF.fields for key in field.keys]
    listed = {_place(key, eye, suffix).upper() for key in keys for eye in ("LEFT", "RIGHT") for suffix in _GRIDS}
    known = {place.partition(".")[0] for place in listed} - listed
    places = [
        place
        for section, keys in sections.items()
        for place in ([f"{section}.{key}" for key in keys] if section in known else [section])
    ]
    return ZED_CONF.notes(name, [place for place in places if place.upper() not in listed])


def _read_sections(content: bytes, problems: list[Problem]) -> _Sections:
    """Return the sections, names in upper and keys in lower case, without the comments after ``;`` and ``#``."""
    content_text, text_problems = decode_text(content)
    problems += text_problems
    sections: dict[str, dict[str, tuple[int, str]]] = {}
    section = ""
    for line_number, line in enumerate(content_text.splitlines(), start=1):
        if len(problems) == MAX_PROBLEMS_SHOWN:
            break
        text = _COMMENT.split(line, maxsplit=1)[0].strip()
        key, *value = (part.strip() for part in _SEPARATOR.split(text, maxsplit=1))
        if text.startswith("[") and text.endswith("]"):
            section = text[1:-1].strip().upper()
            if section in sections:
                place = format_location("", section)
                problems.append(Problem("duplicate", place, f"line {line_number}: the section occurs twice"))
            sections.setdefault(section, {})
        elif key and value and section:
            if key.lower() in sections[section]:
                place = format_location("", section, key)
                problems.append(Problem("duplicate", place, f"line {line_number}: the key occurs twice"))
            sections[section][key.lower()] = line_number, value[0]
        elif text:
            expected = "[SECTION] or key = value" if section else "a [SECTION]"
            problems.append(Problem("syntax", "", f"line {line_number} is {short_repr(text)}", expected))
    return sections


def _nearest_suffix(sections: _Sections, width: int, height: int, problems: list[Problem]) -> str | None:
    """Return the suffix of the sections whose image size is nearest in aspect ratio, then in width.

    Returns None, and adds a problem if there is none yet, if the file has no sections of a known size, and if it
    has none of this size and one of an unknown size.
    """
    present = [name for name in _GRIDS if {camera + name for camera in _CAMERAS} & set(sections)]
    if not present and not problems:
        found = escape_text(", ".join(f"[{name}]" for name in sections) or "no section")
        cameras = ", ".join(f"[LEFT_CAM_{name}]" for name in _GRIDS)
        expected = f"one of {cameras} with its [RIGHT_CAM_...] and [STEREO]"
        problems.append(Problem("missing", "", f"the file has {found}", expected))

    def distance(suffix: str) -> tuple[float, float]:
        grid_width, grid_height = _GRIDS[suffix]
        ratio = grid_width * height / (width * grid_height)
        return round(abs(math.log(ratio)), 9), abs(math.log(grid_width / width))

    nearest = min(present, key=distance, default=None)
    if nearest is None or _GRIDS[nearest] == (width, height):
        return nearest
    known = {camera + name for camera in _CAMERAS for name in _GRIDS}
    unknown = [f"[{escape_text(name)}]" for name in sections if name.startswith(_CAMERAS) and name not in known]
    if not unknown:
        return nearest
    found = f"no section is known to be of {width} x {height} pixels; {', '.join(unknown[:10])} may be"
    expected = "only sections of the size that the images were scaled from, or calibration.toml with that size"
    problems.append(Problem("conflict", "", found, expected))
    return None
