"""Contents of stereo calibration files in both formats, and a helper that writes and reads them."""

from __future__ import annotations

from pathlib import Path

from rebar_depth_bench.captures.calibration import StereoCalibration
from rebar_depth_bench.captures.calibration_files import read_calibration

SHIPPED_CALIBRATION = Path(__file__).parents[3] / "dataset_builder" / "cameras" / "calibrations" / "zed-hd720.conf"


CONF = """\
[LEFT_CAM_HD]
fx=700.5
fy=701.5
cx=640.25
cy=350.75
k1=-0.17
k2=0.03
p1=0.001
p2=-0.002
k3=0.0001

[RIGHT_CAM_HD]
fx=702.5
fy=703.5
cx=633.25
cy=359.75
k1=-0.16
k2=0.02
p1=0.003
p2=-0.004
k3=0.0002

[STEREO]
Baseline=120.5
TY=0.25
TZ=-0.75
CV_HD=0.006
RX_HD=-0.001
RZ_HD=0.0007
"""

_EYES = ("LEFT", "RIGHT")
_PINHOLE = "fx=742.1\nfy=742.1\ncx=961.3\ncy=543.2\n"
_TERMS = "k1=-0.05\nk2=0.01\np1=1e-4\np2=-2e-4\nk3=1e-3\nk4=0\nk5=0\nk6=0\n"
CONF_OF_SIZES = (
    "".join(f"[{eye}_CAM_{size}]\n{_PINHOLE}" for size in ("FHD1200", "FHD") for eye in _EYES)
    + "".join(f"[{eye}_DISTO]\n{_TERMS}" for eye in _EYES)
    + CONF[CONF.index("[STEREO]") :].replace("_HD", "_FHD")
    + "[MISC]\nSensor_ID=1\n"
)
"""File with the distortion of all sizes in sections of its own, for images of 16:9."""


TOML = """\
width = 1280
height = 720
[left]
fx = 700.5
fy = 701.5
cx = 640.25
cy = 350.75
distortion = [-0.17, 0.03, 0.001, -0.002, 0.0001]
[right]
K = [[702.5, 0, 633.25], [0, 703.5, 359.75], [0, 0, 1]]
distortion = [-0.16, 0.02, 0.003, -0.004, 0.0002]
[stereo]
rotation = [-0.001, 0.006, 0.0007]
translation_m = [-0.1205, -0.00025, 0.00075]
"""


def write_and_read(
    folder: Path, text: str | bytes, name: str = "SN1.conf", grid: tuple[int, int] = (1280, 720)
) -> StereoCalibration:
    """Write ``text`` to ``folder / name`` and read it as a calibration for ``grid`` (width, height)."""
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_calibration(path, *grid)
