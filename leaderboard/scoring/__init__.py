"""Checking and scoring of archives in a sandboxed process, and the queue workers that score."""
