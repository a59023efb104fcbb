"""Repositories of the Hugging Face Hub that this project publishes to, through ``huggingface_hub``."""
