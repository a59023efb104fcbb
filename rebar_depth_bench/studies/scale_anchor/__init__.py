"""Scale-anchor study: scale from a few views of known depth."""
