"""Depth checkpoints that run through ``transformers``."""
