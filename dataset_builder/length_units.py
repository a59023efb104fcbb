"""The units of length that users' files may be in."""

from __future__ import annotations

from collections.abc import Mapping

UNITS_M: Mapping[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
"""Metres in one of each named unit."""
