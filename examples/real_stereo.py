"""Real stereo pairs with measured disparity, as captures for ``rebar-bench predict --data``.

    python examples/real_stereo.py motorcycle scikit-image-0.18.3.tar.gz OUT
    python examples/real_stereo.py aloe opencv/usr/share/doc/opencv-doc/examples/data OUT

Both pairs are of the Middlebury stereo data sets (Scharstein et al.), which state no licence; please cite them:

- motorcycle: H. Hirschmueller, D. Scharstein et al., GCPR 2014, at a quarter of its size, in the source
  distribution of scikit-image 0.18.3 (BSD-3-Clause). The camera is the one in its ``skimage/data/__init__.py``.
- aloe: D. Scharstein and C. Pal, CVPR 2007, in Debian's package ``opencv-doc`` (Apache-2.0, as OpenCV). No camera
  is stated there, so the depth below is that of an assumed one and relative errors are those of the disparity.

Each writes ``OUT/<name>/`` with ``left/``, ``right/`` and ``cameras.toml``, and the measured depth of the left
image, metres, as ``OUT/<name>-measured/0001.npy``.
"""

from __future__ import annotations

import hashlib
import io
import sys
import tarfile
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from PIL import Image

SDIST = "scikit-image-0.18.3"
SDIST_SHA256 = "ecae99f93f4c5e9b1bf34959f4dc596c41f2f6b2fc407d9d9ddf85aebd3137ca"
MOTORCYCLE = {"fx": 994.978, "cx": 311.193, "cy": 254.877, "right_cx": 311.193 + 31.086, "baseline_m": 0.193001}
ALOE = {"fx": 1282.0, "cx": 640.5, "cy": 554.5, "right_cx": 640.5, "baseline_m": 0.1}
"""An assumed camera, whose disparity is that of the images."""


def motorcycle(sdist: Path, out: Path) -> None:
    """Write the motorcycle pair from scikit-image's source distribution."""
    content = sdist.read_bytes()
    if hashlib.sha256(content).hexdigest() != SDIST_SHA256:
        raise SystemExit(f"{sdist}: is not {SDIST}.tar.gz, expected the SHA-256 {SDIST_SHA256}")
    with tarfile.open(fileobj=io.BytesIO(content)) as archive:

        def member(name: str) -> io.BytesIO:
            stream = archive.extractfile(f"{SDIST}/skimage/data/{name}")
            assert stream is not None
            return io.BytesIO(stream.read())

        left, right = (Image.open(member(f"motorcycle_{eye}.png")) for eye in ("left", "right"))
        disparity_px = np.load(member("motorcycle_disp.npz"))["arr_0"]
    write(out, "motorcycle", left, right, disparity_px, MOTORCYCLE)


def aloe(folder: Path, out: Path) -> None:
    """Write the aloe pair from the examples of opencv-doc; the measured disparity is in whole pixels."""
    left, right = (Image.open(folder / f"aloe{eye}.jpg") for eye in "LR")
    disparity_px = np.asarray(Image.open(folder / "aloeGT.png")).astype(np.float64)
    write(out, "aloe", left, right, np.where(disparity_px > 0, disparity_px, np.nan), ALOE)


def write(
    out: Path,
    name: str,
    left: Image.Image,
    right: Image.Image,
    disparity_px: Float[ndarray, "h w"],
    camera: dict[str, float],
) -> None:
    """Write a capture of one pair, and the depth that its disparity measures (0: not measured)."""
    for eye, image in (("left", left), ("right", right)):
        (out / name / eye).mkdir(parents=True, exist_ok=True)
        image.convert("RGB").save(out / name / eye / "0001.png")
    fx, cx, cy, right_cx, baseline_m = (camera[key] for key in ("fx", "cx", "cy", "right_cx", "baseline_m"))
    lens = f"fx = {fx}\nfy = {fx}\ncy = {cy}\ndistortion = [0, 0, 0, 0]\n"
    (out / name / "cameras.toml").write_text(
        f"[left]\ncx = {cx}\n{lens}\n[right]\ncx = {right_cx}\n{lens}\n"
        f"[stereo]\nrotation = [0, 0, 0]\nbaseline_m = {baseline_m}\n"
    )
    # u_left - u_right = fx baseline / z + cx_left - cx_right
    depth_m = fx * baseline_m / (disparity_px + right_cx - cx)
    measured = out / f"{name}-measured"
    measured.mkdir(exist_ok=True)
    np.save(measured / "0001.npy", np.where(np.isfinite(depth_m), depth_m, 0).astype(np.float32))


if __name__ == "__main__":
    if len(sys.argv) != 4 or sys.argv[1] not in ("motorcycle", "aloe"):
        raise SystemExit(__doc__)
    {"motorcycle": motorcycle, "aloe": aloe}[sys.argv[1]](Path(sys.argv[2]), Path(sys.argv[3]))
