"""Images of KITTI by date, drive, frame and side, and the Eigen test split.

The 697 test images are those of Eigen et al., "Depth Map Prediction from a Single Image", NeurIPS 2014.
``kitti_eigen_test_697.txt`` is the list that is distributed with public evaluators (Monodepth and its successors),
one image per line: ``<date>/<drive> <frame> <side>``. It contains only names, no KITTI data.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from rebar_depth_bench.errors import InputError, Problem, escape_text
from rebar_depth_bench.limits import TOML_BYTES
from rebar_depth_bench.reading import read_file

CONFIG_NAME = "kitti"
SPLIT_FILE = "kitti_eigen_test_697.txt"
_SPLIT_LINE = re.compile(r"(\d{4}_\d\d_\d\d)/(\1_drive_\d{4}_sync) (\d{10}) ([lr])")
_CAMERAS = {"l": 2, "r": 3}


@dataclass(frozen=True, order=True)
class KittiImage:
    """KITTI image: recording date, drive, frame number (ten digits) and side (``l`` or ``r``)."""

    date: str
    drive: str
    frame: str
    side: str

    @property
    def name(self) -> str:
        """Return the name of the prediction: ``<drive>_<frame>_<side>``."""
        return f"{self.drive}_{self.frame}_{self.side}"

    @property
    def view_id(self) -> str:
        """Return the view id in an archive: ``kitti/<drive>_<frame>_<side>``."""
        return f"{CONFIG_NAME}/{self.name}"

    @property
    def camera(self) -> int:
        """Return the KITTI number of the colour camera: 2 on the left, 3 on the right."""
        return _CAMERAS[self.side]


def eigen_test_images() -> tuple[KittiImage, ...]:
    """Return the 697 test images, sorted by drive and frame, so that consecutive frames are adjacent."""
    return parse_images(SPLIT_FILE, files("rebar_depth_bench.captures").joinpath(SPLIT_FILE).read_bytes())


def read_images(path: Path | None) -> tuple[KittiImage, ...]:
    """Return the sorted images of a list like that of the Eigen split, or the Eigen test split for None.

    Raises ``InputError`` if the file cannot be read, and for an empty list and malformed or repeated lines.
    """
    if path is None:
        return eigen_test_images()
    return parse_images(path, read_file(path, TOML_BYTES, "a list of KITTI images", InputError))


def parse_images(where: object, content: bytes) -> tuple[KittiImage, ...]:
    """Return the sorted images of a list. Raises ``InputError`` as ``read_images``, naming ``where``."""
    images: set[KittiImage] = set()
    problems = []
    for number, line in enumerate(content.decode("utf-8", "replace").splitlines(), start=1):
        match = _SPLIT_LINE.fullmatch(line.strip())
        if match is None:
            found = f"the line is {escape_text(line)}"
            problems.append(Problem("syntax", f"line {number}", found, "<date>/<drive> <frame> l|r"))
            continue
        image = KittiImage(*match.groups())
        if image in images:
            problems.append(Problem("duplicate", f"line {number}", f"{image.name} is listed twice", "once"))
        images.add(image)
    if not images and not problems:
        problems.append(Problem("missing", "", "has no images", "lines such as <date>/<drive> <frame> l|r"))
    if problems:
        raise InputError.from_problems(where, problems)
    return tuple(sorted(images))
