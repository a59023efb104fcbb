"""Views that methods predict: what scenes of a dataset and images of a capture have in common, and the scenes."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.data.rows import iterate_rows
from rebar_depth_bench.errors import DatasetError
from rebar_depth_bench.geometry.aruco_board import BoardSpec


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
        return tuple(map(ConfigViews, self.source.by_scene()))

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
