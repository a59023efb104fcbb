"""Uploads: multipart parsing, validation in a child process, acceptance."""
