"""Images with known cameras that are no dataset folder: captures and image folders."""
