"""Monocular depth checkpoints that run through ``transformers``."""
