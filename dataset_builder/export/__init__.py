"""Export of a dataset folder as plain images, OpenEXR depth, COLMAP models and nerfstudio transforms."""

from dataset_builder.export.exporting import ConfigExport, ExportSummary, export

__all__ = ["ConfigExport", "ExportSummary", "export"]
