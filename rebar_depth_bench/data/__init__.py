"""Dataset folders: manifest, rows, codecs, digests, bars, ground truth and its array cache."""
