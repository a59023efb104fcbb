"""The factory calibration of a Stereolabs camera: an INI file with a section for each eye and grid."""

from __future__ import annotations

import configparser
import math
from collections.abc import Mapping

from rebar_depth_bench.calibration_values import (
    ANGLE,
    BASELINE_MM,
    FOCAL,
    OFFSET_MM,
    TERM,
    Range,
    number,
    principal_range,
)
from rebar_depth_bench.lenses import Lens, StereoCalibration

GRIDS: Mapping[str, tuple[int, int]] = {
    "2K": (2208, 1242),
    "FHD": (1920, 1080),
    "FHD1200": (1920, 1200),
    "HD": (1280, 720),
    "SVGA": (960, 600),
    "VGA": (672, 376),
}
"""The grids of Stereolabs cameras by the suffix of their sections."""

Sections = Mapping[str, Mapping[str, str]]


def parse_conf(text: str, width: int, height: int, problems: list[str]) -> StereoCalibration | None:
    """Return the calibration for a grid of ``width`` x ``height``; none, and further problems, where it fails.

    It is that of the file's own section for this grid, or else the one nearest to it in shape, then in width:
    the caller scales it. Case is of no matter, unknown keys are passed over.
    """
    sections = _sections(text, problems)
    suffix = _suffix(sections, width, height, problems)
    if suffix is None:
        return None
    grid = GRIDS[suffix]
    left, right = (_lens(sections, f"{eye}_CAM_{suffix}", grid, problems) for eye in ("LEFT", "RIGHT"))
    stereo = _Stereo(sections, suffix, problems)
    baseline_mm = stereo.value("BASELINE", BASELINE_MM)
    across_mm = [stereo.value(key, OFFSET_MM, default="0") for key in ("TY", "TZ")]
    rx, cv, rz = (stereo.value(key, ANGLE) for key in ("RX", "CV", "RZ"))
    # The whole vector changes its sign, so that it stays on the line that the vendor's rectification uses.
    translation_m = tuple(0.0 - length / 1000 for length in (baseline_mm, *across_mm))
    return StereoCalibration(*grid, left, right, (rx, cv, rz), translation_m)  # type: ignore[arg-type]


def _sections(text: str, problems: list[str]) -> Sections:
    """Return the file's sections and keys in upper case, comments after ``;`` and ``#`` dropped."""
    parser = configparser.ConfigParser(
        interpolation=None,
        comment_prefixes=(";", "#"),
        inline_comment_prefixes=(";", "#"),
        default_section="",  # no section lends its keys to the others
        empty_lines_in_values=False,
    )
    parser.optionxform = str.upper  # type: ignore[assignment,method-assign]
    try:
        parser.read_string(text, "the file")
    except configparser.Error as error:
        problems.append(f"it is no INI file: {' '.join(error.message.split())}")
        return {}
    found: dict[str, Mapping[str, str]] = {}
    for name in parser.sections():
        if name.strip().upper() in found:
            problems.append(f"section [{name}] stands there twice")
        found[name.strip().upper()] = dict(parser.items(name))
    return found


def _suffix(sections: Sections, width: int, height: int, problems: list[str]) -> str | None:
    """Return the suffix of the sections to read: the exact grid, else the nearest in shape, then in width."""
    present = [suffix for suffix in GRIDS if {f"LEFT_CAM_{suffix}", f"RIGHT_CAM_{suffix}"} & set(sections)]
    if not present:
        if not problems:
            found = ", ".join(f"[{name}]" for name in sections) or "no section"
            wanted = ", ".join(f"[LEFT_CAM_{suffix}]" for suffix in GRIDS)
            problems.append(f"it has {found}, expected one of {wanted}, its [RIGHT_CAM_...] and [STEREO]")
        return None

    def distance(suffix: str) -> tuple[float, float]:
        wide, high = GRIDS[suffix]
        return abs(math.log(wide * height / (width * high))), abs(math.log(wide / width))

    return min(present, key=distance)


def _lens(sections: Sections, name: str, grid: tuple[int, int], problems: list[str]) -> Lens:
    if name not in sections:
        problems.append(f"section [{name}] is missing")
    section = sections.get(name, {})

    def value(key: str, allowed: Range, default: str | None = None) -> float:
        raw = section.get(key.upper(), default)
        if raw is None:
            if name in sections:
                problems.append(f"section [{name}] has no {key}, expected {allowed}")
            return math.nan
        return number(raw, f"section [{name}] {key}", allowed, problems)

    fx, fy = value("fx", FOCAL), value("fy", FOCAL)
    cx, cy = value("cx", principal_range(grid[0])), value("cy", principal_range(grid[1]))
    k1, k2 = value("k1", TERM), value("k2", TERM)
    p1, p2, k3 = (value(key, TERM, default="0") for key in ("p1", "p2", "k3"))
    return Lens(fx, fy, cx, cy, (k1, k2, p1, p2, k3))


class _Stereo:
    """The section between the two eyes, whose keys bear the grid's suffix or none."""

    def __init__(self, sections: Sections, suffix: str, problems: list[str]) -> None:
        self._section = sections.get("STEREO")
        self._suffix = suffix
        self._problems = problems
        if self._section is None:
            problems.append("section [STEREO] is missing")

    def value(self, key: str, allowed: Range, default: str | None = None) -> float:
        if self._section is None:
            return math.nan
        names = [name for name in (f"{key}_{self._suffix}", key) if name in self._section]
        if names:
            return number(self._section[names[0]], f"section [STEREO] {names[0]}", allowed, self._problems)
        if default is None:
            self._problems.append(f"section [STEREO] has no {key}_{self._suffix} and no {key}, expected {allowed}")
            return math.nan
        return float(default)
