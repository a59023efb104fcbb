"""Layout ``plain``: images, depth and masks of each eye, ``cameras.json``, COLMAP's and nerfstudio's cameras."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from dataset_builder.export.colmap import cameras_txt, images_txt, points_txt
from dataset_builder.export.images import EXPORT_FILES
from dataset_builder.export.layout import ExportedConfig, ImageFile, Layout
from dataset_builder.export.metadata import cameras_json, exported_files, readme_txt
from dataset_builder.export.nerfstudio import transforms_json
from dataset_builder.export.views import CameraView
from rebar_depth_bench.data.dataset_config import DatasetConfig


class PlainLayout(Layout):
    """Files that ``README.txt`` in the folder describes."""

    def check(self, config: DatasetConfig) -> None:
        """Accept every config."""

    def folders(self, config: DatasetConfig) -> Iterable[str]:
        """Return the folders with files."""
        del config
        return (".", "sparse/0", *sorted({file.folder for file in EXPORT_FILES.values()}))

    def images(self, config: DatasetConfig, view: CameraView) -> Iterator[ImageFile]:
        """Yield the files of both eyes."""
        for eye in view.cameras:
            for file in exported_files(config).values():
                yield ImageFile(file.path(view.stem(eye)), f"{eye}_{file.column}", file.encode)

    def texts(self, exported: ExportedConfig) -> Mapping[str, str]:
        """Return the metadata; COLMAP's and nerfstudio's files describe colour images."""
        folder, config, views = exported.folder, exported.config, exported.views
        texts = {
            "cameras.json": cameras_json(folder, config, views),
            "README.txt": readme_txt(folder, config, len(views)),
        }
        if config.colour is not None:
            texts |= {
                "sparse/0/cameras.txt": cameras_txt(views),
                "sparse/0/images.txt": images_txt(views),
                "sparse/0/points3D.txt": points_txt(exported.bars.get(config.scene.name, ())),
                "transforms.json": transforms_json(views),
            }
        return texts
