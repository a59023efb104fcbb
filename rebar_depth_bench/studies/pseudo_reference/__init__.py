"""Pseudo-reference study: full-frame scores against estimated depth."""
