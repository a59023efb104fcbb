"""Dataset folders: manifest, shards, rows, codecs, digests, bars, array cache."""
