"""Upload handling: multipart parsing, validation in a child process, acceptance."""
