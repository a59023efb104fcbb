"""All views of one config, as a method that needs more than one at once sees them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rebar_depth_bench.board import BoardSpec
from rebar_depth_bench.dataset import iterate
from rebar_depth_bench.errors import DatasetError
from rebar_depth_bench.folder import DatasetFolder


@dataclass(frozen=True)
class ConfigViews:
    """One config of a dataset folder."""

    folder: DatasetFolder
    config: str

    @property
    def view_ids(self) -> tuple[str, ...]:
        """The views' ids, in order."""
        return tuple(view.view_id for view in self.folder.views(self.config))

    @property
    def grid(self) -> tuple[int, int]:
        """(height, width) of the pictures, pixels."""
        return self.folder.grid(self.config)

    @property
    def board(self) -> BoardSpec | None:
        """The board under the assembly, None where there is none. Raises ``DatasetError`` for a damaged one."""
        board = self.folder.config(self.config)["scene"].get("board")
        try:
            return None if board is None else BoardSpec(**board)
        except TypeError as error:
            raise DatasetError(
                f"{self.folder.root}: config {self.config}: the board is damaged: {error}"
            ) from None

    @property
    def mesh(self) -> Path:
        """The PLY file of the scene's mesh, which is ground truth. Raises ``DatasetError`` if it is not there."""
        return self.folder.file(self.folder.config(self.config)["mesh"])

    def rows(self, *columns: str) -> Iterator[dict[str, Any]]:
        """Yield ``view_id`` and the named columns of every view, decoded, one by one, in order."""
        return iterate(self.folder.root, self.config, ("view_id", *columns))
