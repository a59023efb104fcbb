"""Rows of a config: decoding of the cells, cameras with their ground truth, and the views that methods predict.

The shards are read with pyarrow: ``datasets`` takes a second to import, and imports torch, which takes several, to
stream.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8, UInt16
from numpy import ndarray

from rebar_depth_bench.base.errors import DatasetError, Problem, escape_text, library_message
from rebar_depth_bench.base.parallel import Progress, silent
from rebar_depth_bench.base.validation import short_repr
from rebar_depth_bench.data import codecs
from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.data.schema import CAMERA_SHAPES, COLUMNS, EYES, column_kind
from rebar_depth_bench.data.shards import encoded_rows
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.geometry.cameras import Camera, is_rigid

TRUTH_COLUMNS = tuple(name for name in COLUMNS if name.endswith(("_depth", "_mask", "_bars", "_preview")))
"""Columns of ground truth about the scene; the preview shows depth."""
POSE_COLUMNS = tuple(f"{eye}_cam_from_world" for eye in EYES)
"""Columns of the poses in the world, which are ground truth; the pose between the two eyes is calibration."""


@dataclass(frozen=True, eq=False)
class EyeTruth:
    """Camera and images of one eye of a view, rendered or imported.

    ``rgb`` is None where colour is not needed. ``depth_m`` is planar z (0: no surface), ``mask`` marks steel
    pixels, ``bars`` holds bar ids (0: no steel). Mask and bar ids are None in a config that was imported without.
    """

    camera: Camera
    rgb: UInt8[ndarray, "h w 3"] | None
    depth_m: Float32[ndarray, "h w"]
    mask: Bool[ndarray, "h w"] | None
    bars: UInt16[ndarray, "h w"] | None

    def digest(self) -> str:
        """Return the hex SHA-256 of the ground truth: image size, depth, mask, bar ids and camera.

        The digest covers the decoded values, not their encoding, and which of them are absent.
        """
        digest = hashlib.sha256(np.array(self.depth_m.shape, "<u4").tobytes())
        arrays = (
            (self.depth_m, "<f4"),
            (self.mask, "u1"),
            (self.bars, "<u2"),
            (self.camera.K, "<f8"),
            (self.camera.distortion, "<f8"),
            (self.camera.cam_from_world, "<f8"),
        )
        for array, dtype in arrays:
            digest.update(b"absent" if array is None else np.ascontiguousarray(array, dtype=dtype).data)
        return digest.hexdigest()


@dataclass(frozen=True, eq=False)
class RenderedEye(EyeTruth):
    """One eye of a rendered view, which has a mask and bar ids."""

    mask: Bool[ndarray, "h w"]
    bars: UInt16[ndarray, "h w"]


def truth_columns(eye: str) -> tuple[str, ...]:
    """Return the names of the columns that ``truth_from_row`` requires for ``left`` or ``right``."""
    return tuple(f"{eye}_{kind}" for kind in ("depth", "mask", "bars", *CAMERA_SHAPES))


def truth_from_row(row: Mapping[str, Any], eye: str) -> EyeTruth:
    """Return one eye of a decoded row that has its depth; ``rgb`` is None if the row lacks that column."""
    depth_m = row[f"{eye}_depth"]
    camera = camera_from_row(row, eye, depth_m.shape[:2])  # A damaged image may have a third axis.
    return EyeTruth(camera, row.get(f"{eye}_rgb"), depth_m, row[f"{eye}_mask"], row[f"{eye}_bars"])


def camera_from_row(row: Mapping[str, Any], eye: str, grid: tuple[int, int]) -> Camera:
    """Return the camera of one eye of a row, decoded or not; ``grid`` is its image size (height, width).

    Raises ``ValueError`` for cells that ``camera_array`` rejects.
    """
    K, distortion, cam_from_world = (camera_array(kind, row[f"{eye}_{kind}"]) for kind in CAMERA_SHAPES)
    height, width = grid
    return Camera(K, distortion, cam_from_world, width, height)


def absent_cell(kind: str) -> list[Any] | None:
    """Return the cell of an absent column: null, or NaN for ``CAMERA_SHAPES``.

    Parquet readers of Arrow fail on null lists of a fixed size.
    """
    return np.full(CAMERA_SHAPES[kind], np.nan).tolist() if kind in CAMERA_SHAPES else None


def is_absent(cell: Any) -> bool:
    """Return whether a cell is null, or a list of NaN."""
    return cell is None or (isinstance(cell, list) and len(cell) > 0 and bool(np.isnan(np.ravel(cell)).all()))


def camera_array(kind: str, cell: Any) -> Float64[ndarray, ...]:
    """Return a cell of one of ``CAMERA_SHAPES`` as an array; arrays are returned unchanged.

    Raises ``ValueError`` unless it holds finite numbers of the kind's shape; a pose has to be rigid.
    """
    if isinstance(cell, ndarray):
        return cell
    array = np.array(cell, dtype=np.float64)
    if array.shape != CAMERA_SHAPES[kind]:
        raise ValueError(f"it has the shape {array.shape}, expected {CAMERA_SHAPES[kind]}")
    if not np.isfinite(array).all():
        raise ValueError("it has values that are not finite, expected finite numbers")
    if kind == "cam_from_world" and not is_rigid(array):
        raise ValueError("it is no rigid pose: a rotation, a translation and the last row 0 0 0 1")
    return array


def decode_row(config: DatasetConfig, row: Mapping[str, Any]) -> dict[str, Any]:
    """Decode the cells of a row of a config; the cells of its absent columns decode to None.

    Raises ``DatasetError`` naming view and column if a cell is damaged or contradicts the manifest.
    """
    view_id = str(row.get("view_id", f"a view of {config.name}"))
    return {column: decode_cell(config, column, cell, view_id) for column, cell in row.items()}


def decode_cell(config: DatasetConfig, column: str, cell: Any, view_id: str) -> Any:
    """Decode one cell of a row of a config.

    Raises ``DatasetError`` naming view and column if the cell is damaged or contradicts the manifest.
    """
    kind = column_kind(column)
    with _named_damage(config.root, view_id, column):
        if column in config.absent_columns:
            if not is_absent(cell):
                raise ValueError("it has a value, expected null as in the manifest")
            return None
        if kind in codecs.PICTURE_KINDS:
            return codecs.decode(kind, _content(kind, cell), config.grid)
        if kind in CAMERA_SHAPES:
            return camera_array(kind, cell)
        if kind == "view_id" and cell not in config.scene_by_view:
            raise ValueError("it is not in the manifest")
        if kind == "scene" and cell != (expected := config.scene_by_view.get(view_id, cell)):
            raise ValueError(f"got {short_repr(cell)}, expected {expected} as in the manifest")
        if kind == "baseline_m" and not (isinstance(cell, float) and math.isfinite(cell)):
            raise ValueError(f"got {cell}, expected a length in metres")
        return cell


_IMAGE_OF_SHARD = "rebar-depth-bench:"
"""Start of the paths in the cells of ``image_cell``."""


def image_cell(config: DatasetConfig, column: str, cell: Any, view_id: str) -> dict[str, Any]:
    """Return a cell of ``datasets.Image`` with the encoded image in a cell of a shard.

    The path in the returned cell is no file: it names root, view and size for ``open_image_cell``. Raises
    ``DatasetError`` if the cell of the shard has no image.
    """
    height, width = config.grid
    with _named_damage(config.root, view_id, column):
        content = _content(column_kind(column), cell)
    return {"bytes": content, "path": f"{_IMAGE_OF_SHARD}{config.root}/{view_id}/{height}x{width}"}


def is_image_cell(cell: Mapping[str, Any]) -> bool:
    """Return whether a cell of ``datasets.Image`` is from ``image_cell``."""
    return (cell["path"] or "").startswith(_IMAGE_OF_SHARD)


def open_image_cell(column: str, cell: Mapping[str, Any]) -> codecs.Picture:
    """Decode the image in a cell of ``image_cell``.

    Raises ``DatasetError`` naming view and column if the image is damaged or has another size.
    """
    root, config, view, size = cell["path"].removeprefix(_IMAGE_OF_SHARD).rsplit("/", 3)
    height, width = map(int, size.split("x"))
    with _named_damage(root, f"{config}/{view}", column):
        return codecs.open_picture(column_kind(column), cell["bytes"], (height, width))


@contextmanager
def _named_damage(root: str, view_id: str, column: str) -> Iterator[None]:
    """Convert the errors of a damaged cell to ``DatasetError``.

    Raises ``InputError`` instead if Pillow lacks a codec.
    """
    try:
        yield
    except Exception as error:  # Pillow raises many types, which depend on the damage.
        codecs.check_codecs()
        reason = library_message(error)
        raise DatasetError(
            f"{root}: view {escape_text(view_id)}: {column} is damaged: {reason}; "
            f"rebar-bench verify {root} lists damaged files"
        ) from error


def _content(kind: str, cell: Any) -> bytes:
    """Return the encoded image in a cell of a shard. A cell of another type raises an error of any type."""
    content = cell if kind == "depth" else cell["bytes"]
    if not isinstance(content, bytes):
        raise ValueError("the cell holds no bytes")
    return content


def iterate_rows(
    config: DatasetConfig, columns: Sequence[str], view_ids: Collection[str] | None = None
) -> Iterator[dict[str, Any]]:
    """Yield the decoded rows of a config, or of some of its views, one at a time and without a cache.

    Raises ``DatasetError`` if a shard or a cell is damaged, and if a view is missing.
    """
    return (decode_row(config, row) for row in encoded_rows(config, columns, view_ids))


# Comparison of the rows with the manifest, for ``rebar-bench verify``.


def truth_problems(config: DatasetConfig, progress: Progress = silent) -> Iterator[Problem]:
    """Yield a problem for each view whose cameras or ground truth differ from the digests of the manifest.

    Raises ``DatasetError`` for damaged shards and rows that are not the views of the manifest.
    """
    records = {record.view_id: record for record in config.views}
    columns = ("view_id", "scene", *(name for eye in config.truth_eyes for name in truth_columns(eye)))
    for done, row in enumerate(iterate_rows(config, columns), start=1):
        record = records[row["view_id"]]
        for eye in config.truth_eyes:
            digest, expected = truth_from_row(row, eye).digest(), getattr(record, eye)
            if digest != expected:
                found = f"the {eye} ground truth has the digest {digest[:16]}"
                yield Problem("conflict", record.view_id, found, f"{expected[:16]} as in the manifest")
        progress(f"ground truth of {config.name}", done, len(records))


# Views for methods: from a dataset, or pictures without ground truth.


class Views(Protocol):
    """Views of one image size. A row has the columns of a dataset (``schema.COLUMNS``), decoded."""

    @property
    def config(self) -> str:
        """Name of the config, with split and scene if it has several scenes, or of the capture."""

    @property
    def view_ids(self) -> tuple[str, ...]:
        """Ids of the views, in order."""

    @property
    def grid(self) -> tuple[int, int]:
        """Image size (height, width), pixels."""

    @property
    def board(self) -> BoardSpec | None:
        """ArUco board under the assembly, or None."""

    @property
    def mesh(self) -> Path:
        """Path of the scene's PLY mesh, which is ground truth. Raises ``InputError`` if there is none."""

    @property
    def has_poses(self) -> bool:
        """Whether all views have poses in one world frame; else the world frame of a view is its left camera."""

    @property
    def rectify(self) -> bool:
        """Whether single-view methods that do not read the lens distortion are given rectified images."""

    @property
    def identity(self) -> Any:
        """JSON value that differs for other images or cameras."""

    def by_scene(self) -> Sequence[Views]:
        """Return the views of each scene."""

    def check_columns(self, columns: Sequence[str], reader: str) -> None:
        """Raise ``InputError`` if the views lack columns that ``reader`` needs."""

    def rows(self, *columns: str, skip: Collection[str] = ()) -> Iterator[dict[str, Any]]:
        """Yield the decoded ``view_id`` and named columns of each view that is not in ``skip``, in order.

        Raises ``InputError`` for columns that the views lack, and for damaged images.
        """


@dataclass(frozen=True)
class ConfigViews:
    """Views of scenes of a dataset's config; ``board`` and ``mesh`` need a config of one scene (see ``Views``)."""

    source: DatasetConfig

    @property
    def config(self) -> str:
        """Name of the config, with split and scene if it has several scenes."""
        return self.source.label

    @property
    def view_ids(self) -> tuple[str, ...]:
        """Ids of the views, in order."""
        return self.source.view_ids

    @property
    def grid(self) -> tuple[int, int]:
        """Image size (height, width), pixels."""
        return self.source.grid

    @property
    def board(self) -> BoardSpec | None:
        """ArUco board under the assembly, or None."""
        return self.source.scene.board

    @property
    def mesh(self) -> Path:
        """Path of the scene's PLY mesh, which is ground truth. Raises ``DatasetError`` if it is missing."""
        return self.source.file(self.source.mesh)

    @property
    def has_poses(self) -> bool:
        """Whether all views of a scene have poses in its world frame."""
        return self.source.imported is None or self.source.imported.has_poses

    @property
    def rectify(self) -> bool:
        """False: on the raw grid of a config, methods see what the camera sees."""
        return False

    @property
    def identity(self) -> list[str]:
        """Key of the build and digest of the ground truth."""
        return [self.source.key, self.source.ground_truth_digest]

    def by_scene(self) -> tuple[ConfigViews, ...]:
        """Return the views of each scene."""
        return tuple(replace(self, source=source) for source in self.source.by_scene())

    def check_columns(self, columns: Sequence[str], reader: str) -> None:
        """Raise ``DatasetError`` if ``reader`` needs columns that the config was built or imported without."""
        needed = [name for name in columns if name in self.source.absent_columns]
        if not needed:
            return
        place = f"{self.source.root}: {reader} needs {', '.join(needed)}, but config {self.source.name} was"
        if self.source.imported is not None:
            raise DatasetError(f"{place} imported without them; choose other configs (--config)")
        raise DatasetError(
            f"{place} built without colour (rebar-build --no-colour); choose configs with colour (--config), or "
            "build it with colour"
        )

    def rows(self, *columns: str, skip: Collection[str] = ()) -> Iterator[dict[str, Any]]:
        """Yield the decoded ``view_id`` and named columns of each view that is not in ``skip``, in order.

        Raises ``DatasetError`` for columns that the config lacks.
        """
        self.check_columns(columns, "the method")
        wanted = [view_id for view_id in self.view_ids if view_id not in skip] if skip else None
        return iterate_rows(self.source, ("view_id", *columns), wanted)
