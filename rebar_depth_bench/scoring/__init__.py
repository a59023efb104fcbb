"""Scoring: protocol, metrics, bootstrap intervals, results and comparisons."""
