"""Views that methods predict: what the scenes of a dataset and the images of a capture have in common."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol

from rebar_depth_bench.geometry.aruco_board import BoardSpec


class Views(Protocol):
    """Views of one image size. A row has the columns of a dataset (``columns.COLUMNS``), decoded."""

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
