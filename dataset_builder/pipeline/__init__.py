"""Dataset builds: planning of work units, local and cluster rendering, publishing of shards and metadata."""
