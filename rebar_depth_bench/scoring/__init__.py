"""Scoring of submissions: protocol, metrics, bootstrap intervals, results and comparisons."""
