"""The KITTI test images of Eigen et al., "Depth Map Prediction from a Single Image", NeurIPS 2014: 697 names.

``kitti_eigen_test_697.txt`` is the list as it goes round with public evaluators (Monodepth and its successors), a
line an image: ``<date>/<drive> <frame> <side>``. It holds names only, no data of KITTI.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib.resources import files

from rebar_depth_bench.errors import RebarDepthError

CONFIG = "kitti"
SPLIT_FILE = "kitti_eigen_test_697.txt"
_LINE = re.compile(r"(\d{4}_\d\d_\d\d)/(\1_drive_\d{4}_sync) (\d{10}) ([lr])")
_CAMERAS = {"l": 2, "r": 3}


@dataclass(frozen=True, order=True)
class KittiImage:
    """One image: the day it was recorded, its drive, its frame number of ten digits, its side l or r."""

    date: str
    drive: str
    frame: str
    side: str

    @property
    def name(self) -> str:
        """The name of its prediction: ``<drive>_<frame>_<side>``."""
        return f"{self.drive}_{self.frame}_{self.side}"

    @property
    def view_id(self) -> str:
        """Its id in an archive: ``kitti/<drive>_<frame>_<side>``."""
        return f"{CONFIG}/{self.name}"

    @property
    def camera(self) -> int:
        """The colour camera's number in KITTI: 2 on the left, 3 on the right."""
        return _CAMERAS[self.side]


def eigen_test_images() -> tuple[KittiImage, ...]:
    """Return the 697 images, sorted: neighbours in time stand together."""
    return read_split(files("rebar_depth_bench.studies").joinpath(SPLIT_FILE).read_text(encoding="ascii"))


def read_split(text: str) -> tuple[KittiImage, ...]:
    """Return the images of a split list, sorted. Raises ``RebarDepthError`` for a line that is none or twice."""
    images: set[KittiImage] = set()
    for number, line in enumerate(text.splitlines(), start=1):
        match = _LINE.fullmatch(line.strip())
        if match is None:
            raise RebarDepthError(f"{SPLIT_FILE}: line {number} is {line!r}, expected <date>/<drive> <frame> l|r")
        image = KittiImage(*match.groups())
        if image in images:
            raise RebarDepthError(f"{SPLIT_FILE}: line {number}: {image.name} stands twice")
        images.add(image)
    return tuple(sorted(images))
