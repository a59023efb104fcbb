"""Layout of an exported config: its image files, its texts, and the folders that hold them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dataset_builder.export.views import CameraView
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.data.dataset_config import DatasetConfig
from rebar_depth_bench.data.manifest import DatasetFolder


@dataclass(frozen=True)
class ImageFile:
    """Image file of a view: its path in the config's folder, the column that it contains, and its encoder."""

    path: str
    column: str
    encode: Callable[[Any], bytes]


@dataclass(frozen=True, eq=False)
class ExportedConfig:
    """Config of a dataset with one scene, or one scene of another, its exported views, and the bars by scene."""

    folder: DatasetFolder
    config: DatasetConfig
    views: Sequence[CameraView]
    bars: Mapping[str, tuple[Bar, ...]]


class Layout(ABC):
    """Files of an exported config."""

    @abstractmethod
    def check(self, config: DatasetConfig) -> None:
        """Raise ``InputError`` if a config cannot be exported in this layout."""

    @abstractmethod
    def folders(self, config: DatasetConfig) -> Iterable[str]:
        """Return the folders with files, relative to the config's folder, which is "."."""

    @abstractmethod
    def images(self, config: DatasetConfig, view: CameraView) -> Iterable[ImageFile]:
        """Return the image files of a view."""

    @abstractmethod
    def texts(self, exported: ExportedConfig) -> Mapping[str, str]:
        """Return the other files, text by path."""
