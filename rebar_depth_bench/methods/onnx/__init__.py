"""Depth models stored as ONNX files and described by a TOML file."""
