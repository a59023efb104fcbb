"""Export of a dataset folder: images, OpenEXR depth, COLMAP models, nerfstudio transforms; data of Ultralytics."""

from dataset_builder.export.exporting import ConfigExport, export

__all__ = ["ConfigExport", "export"]
