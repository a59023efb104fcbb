"""Export of a dataset folder as plain images, OpenEXR depth, COLMAP models and nerfstudio transforms."""

from dataset_builder.export.exporting import ConfigExport, export

__all__ = ["ConfigExport", "export"]
