"""Stereo calibration files: Stereolabs ``.conf`` or TOML, scaled to the requested image size."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from rebar_depth_bench.base.errors import CalibrationError, EntryError, Problem, escape_text
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
    Side,
    StereoCalibration,
    principal_point,
    quantity,
    scaled_calibration,
    table_calibration,
)
from rebar_depth_bench.captures.fields import LENS_TERMS, lens_problem, unknown_keys_notes
from rebar_depth_bench.geometry.cameras import NOMINAL_HEIGHT, NOMINAL_WIDTH


def read_calibration(path: str | Path, width: int, height: int) -> StereoCalibration:
    """Read a stereo calibration from a ``.conf`` or ``.toml`` file, for images of ``width`` x ``height`` pixels.

    ``.conf`` is Stereolabs' INI file, whose keys docs/formats.md lists: sections ``LEFT_CAM_X``, ``RIGHT_CAM_X``
    for each image size X, such as HD, and ``STEREO``. If the file has no sections for the requested size, those
    nearest in aspect ratio and then in width are read and passed to ``scale_calibration``, which assumes that both
    sizes cover the same sensor area; a file that shows that they do not, or has sections of unknown sizes, is
    refused. The motion is ``x_right = R x_left + T`` with R = Rodrigues(RX, CV, RZ) and T = -(Baseline, TY, TZ):
    the whole vector is negated, which keeps it on the line that the vendor's rectification uses.

    ``fields.READABLE`` shows a ``.toml`` file. The default of ``width`` and ``height``, the image size of the
    calibration, is the requested size. K may replace fx, fy, cx and cy, and they K; ``rotation`` may be a 3 x 3
    matrix, and ``baseline_m = 0.12`` may replace ``translation_m = [-0.12, 0, 0]``; k3 may be absent.

    Raises ``CalibrationError`` with a problem of the file, or all problems of a ``.toml`` file; also if a
    distortion model cannot be inverted over the whole image, if the requested size is not 16 to 16384 pixels each,
    and if its aspect ratio is another one.
    """
    calibration = own_calibration(Path(path), width, height, is_stereo=True)
    assert isinstance(calibration, StereoCalibration)
    return calibration


def own_calibration(
    path: Path, width: Side, height: Side, *, is_stereo: bool, is_scaled: bool = True
) -> Calibration:
    """Return the calibration in a file as ``read_calibration``; a ``.toml`` file may have one camera.

    Unless ``is_scaled``, it is that of the image size in the file that is nearest to the requested one.
    """
    suffix = path.suffix.lower()
    if suffix not in (".conf", ".toml"):
        problem = Problem("invalid", "", f"the file suffix is {path.suffix!r}", ".conf or .toml")
        raise CalibrationError.from_problems(path, [problem])
    content = read_file(path, TOML_BYTES, "a calibration file", CalibrationError)
    check_image_size(path, width, height)
    if suffix == ".conf":
        try:
            pair = _read_conf(path.name, content, width, height)
            return scaled_calibration(pair, path, *((width, height) if is_scaled else (None, None)))
        except EntryError as error:
            raise CalibrationError.from_problems(path, error.problems) from None
    document, problems = parse_toml(content)
    is_pair = is_stereo or "right" in document
    calibration = None if problems else table_calibration(document, width, height, problems, is_stereo=is_pair)
    if calibration is None:
        raise CalibrationError.from_problems(path, problems)
    return scaled_calibration(calibration, path, width, height)


def check_image_size(path: object, width: Side, height: Side) -> None:
    """Raise ``CalibrationError`` for images of a size that the calibration ``path`` cannot be scaled to."""
    if not all(side_px is None or side_px in SIDES_PX for side_px in (width, height)):
        expected = f"{SIDES_PX[0]} to {SIDES_PX[-1]} pixels each"
        problem = Problem("invalid", "", f"it is requested for images of {width} x {height}", expected)
        raise CalibrationError.from_problems(path, [problem])


# Stereolabs' files, an INI format.

ZED_SIZES: Mapping[str, tuple[int, int]] = {
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
_PINHOLE = ("fx", "fy", "cx", "cy")
_TERMS = (*LENS_TERMS, "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY")
"""Distortion terms in OpenCV's order."""
_STEREO: Mapping[str, Expected] = {
    "Baseline": quantity(1, 10_000, "millimetres"),
    **dict.fromkeys(("TY", "TZ"), quantity(-1000, 1000, "millimetres")),
    **dict.fromkeys(("RX", "CV", "RZ"), ANGLE_RAD),
}
_OPTIONAL = (*_TERMS[2:], "TY", "TZ")
"""Keys that may be missing, which means 0."""
_CAMERAS = {f"{eye}_CAM_{size}" for eye in ("LEFT", "RIGHT") for size in ZED_SIZES}
_KNOWN = {
    **dict.fromkeys(_CAMERAS, (*_PINHOLE, *_TERMS)),
    **dict.fromkeys(("LEFT_DISTO", "RIGHT_DISTO"), _TERMS),
    "STEREO": (*_STEREO, *(f"{key}_{size}" for key in _STEREO for size in ZED_SIZES)),
}
"""Keys of the sections that are read."""
_Sections = Mapping[str, Mapping[str, str]]
"""Texts by section and key, in capitals."""
_COMMENT = re.compile(r"(?:^|\s)[;#]")
_SEPARATOR = re.compile("[=:]")


def _read_conf(name: str, content: bytes, width: Side, height: Side) -> StereoCalibration:
    """Return the calibration of a Stereolabs ``.conf`` file for one of its image sizes; the caller scales it.

    The size is that of ``_nearest_size``. Section names and keys are case-insensitive. Raises ``EntryError`` for
    the first problem.
    """
    sections = _read_sections(content)
    size = _nearest_size(sections, width, height)
    left, right = (_read_lens(sections, eye, size) for eye in ("LEFT", "RIGHT"))
    baseline_mm, y_mm, z_mm, rx, cv, rz = _numbers(sections, ("STEREO",), _STEREO, f"_{size}")
    translation_m = (0.0 - baseline_mm / 1000, 0.0 - y_mm / 1000, 0.0 - z_mm / 1000)
    keys, known = list[str](), {"MISC"}
    for section, texts in sections.items():
        keys += [f"{section}.{key}" for key in texts] if section in _KNOWN else [section]
        known.update(f"{section}.{key}".upper() for key in _KNOWN.get(section, ()))
    notes = unknown_keys_notes(name, keys, known)
    if not {width, height} <= {None, *ZED_SIZES[size]}:
        sides = " x ".join(map(str, ZED_SIZES[size]))
        notes.append(f"{name}: scaled from {size}, {sides}, as if both sizes showed the same part of the sensor")
    return StereoCalibration(*ZED_SIZES[size], left, right, (rx, cv, rz), translation_m, tuple(notes))


def _read_sections(content: bytes) -> _Sections:
    """Return the texts by section and key, without the comments after ``;`` and ``#``. Raises ``EntryError``."""
    content_text, problems = decode_text(content)
    if problems:
        raise EntryError(problems[0])
    sections: dict[str, dict[str, str]] = {}
    section = ""
    for line_number, line in enumerate(content_text.splitlines(), start=1):
        text = _COMMENT.split(line, maxsplit=1)[0].strip()
        key, *value = (part.strip() for part in _SEPARATOR.split(text, maxsplit=1))
        if text.startswith("[") and text.endswith("]"):
            section = text[1:-1].strip().upper()
            if section in sections:
                found = f"line {line_number}: the section occurs twice"
                raise EntryError(Problem("duplicate", format_location("", section), found))
            sections[section] = {}
        elif key and value and section:
            if key.upper() in sections[section]:
                found = f"line {line_number}: the key occurs twice"
                raise EntryError(Problem("duplicate", format_location("", section, key), found))
            sections[section][key.upper()] = value[0]
        elif text:
            found, expected = f"line {line_number} is {short_repr(text)}", "[SECTION], or key = value in a section"
            raise EntryError(Problem("syntax", "", found, expected))
    return sections


def _nearest_size(sections: _Sections, width: Side, height: Side) -> str:
    """Return the name of the image size of the file that is nearest in aspect ratio, then in width.

    Of one side alone, it is the size whose side is nearest, and without a size that nearest to HD.
    Raises ``EntryError`` if the file has no sections of a known size, and if it has none of this size and one of
    an unknown size.
    """
    present = [name for name in ZED_SIZES if {f"LEFT_CAM_{name}", f"RIGHT_CAM_{name}"} & set(sections)]
    if not present:
        found = escape_text(", ".join(f"[{name}]" for name in sections) or "no section")
        cameras = ", ".join(f"[LEFT_CAM_{name}]" for name in ZED_SIZES)
        expected = f"one of {cameras} with its [RIGHT_CAM_...] and [STEREO]"
        raise EntryError(Problem("missing", "", f"the file has {found}", expected))

    wanted = (width, height) if width or height else (NOMINAL_WIDTH, NOMINAL_HEIGHT)

    def distance(name: str) -> tuple[float, float]:
        sides = zip(ZED_SIZES[name], wanted, strict=True)
        scales = [math.log(side_px / wanted_px) for side_px, wanted_px in sides if wanted_px]
        return round(abs(scales[0] - scales[-1]), 9), abs(scales[0])

    nearest = min(present, key=distance)
    sizes = [name for name in sections if name.startswith(("LEFT_CAM_", "RIGHT_CAM_"))]
    unknown = [f"[{escape_text(name)}]" for name in sizes if name not in _CAMERAS]
    if unknown and any(distance(nearest)):
        size = " x ".join(str(side_px) for side_px in wanted if side_px)
        found = f"no section is known to be of {size} pixels; {', '.join(unknown[:10])} may be"
        expected = "only sections of the size that the images were scaled from, or calibration.toml with that size"
        raise EntryError(Problem("conflict", "", found, expected))
    return nearest


def _read_lens(sections: _Sections, eye: str, size: str) -> Lens:
    """Return the lens of the camera ``eye`` for an image size. Raises ``EntryError``."""
    camera, distortion = f"{eye}_CAM_{size}", f"{eye}_DISTO"
    width, height = ZED_SIZES[size]
    bounds = (FOCAL_PX, FOCAL_PX, principal_point(width), principal_point(height))
    fx, fy, cx, cy = _numbers(sections, (camera,), dict(zip(_PINHOLE, bounds, strict=True)))
    terms = _numbers(sections, (distortion, camera), dict.fromkeys(_TERMS, DISTORTION))
    while terms[5:] and not terms[-1]:
        terms.pop()
    older, newer = sections[camera], sections.get(distortion, {})
    is_fisheye = "K4" in {*older, *newer} and {*older, *newer}.isdisjoint(("P1", "P2"))
    models = {"the lens model": "fisheye, k1 k2 k3 k4"} if is_fisheye else {}
    if problem := lens_problem(distortion if newer else camera, models, terms):
        raise EntryError(problem)
    for key in _TERMS:
        texts = [section[key.upper()] for section in (older, newer) if key.upper() in section]
        if len(set(map(parse_number, texts))) > 1:
            found = f"differs from {camera}.{key}"
            raise EntryError(Problem("conflict", f"{distortion}.{key}", found, "one lens model"))
    return Lens(fx, fy, cx, cy, (terms[0], terms[1], terms[2], terms[3], terms[4]))


def _numbers(
    sections: _Sections, places: Sequence[str], keys: Mapping[str, Expected], end: str = ""
) -> list[float]:
    """Return the numbers of ``keys``, which may end with ``end``, each in the first of the sections ``places``.

    Raises ``EntryError`` for a missing or invalid key, and if the last section is missing.
    """
    if places[-1] not in sections:
        raise EntryError(Problem("missing", places[-1], "missing", "a section"))
    numbers = []
    for key, expected in keys.items():
        found = [
            (f"{section}.{name}", sections[section][name.upper()])
            for section in places
            for name in (key + end, key)
            if name.upper() in sections.get(section, {})
        ]
        if not found and key not in _OPTIONAL:
            raise EntryError(Problem("missing", f"{places[-1]}.{key}", "missing", expected.text))
        place, text = found[0] if found else ("", "0")
        numbers.append(parse_number(text))
        if found and not expected.accept(numbers[-1]):
            raise EntryError(Problem("invalid", place, f"got {short_repr(text)}", expected.text))
    return numbers
