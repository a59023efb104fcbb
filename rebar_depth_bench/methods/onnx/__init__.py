"""ONNX depth models described by a TOML file."""
