"""The paper's networks, run with their authors' code and weights that the user provides or downloads."""
