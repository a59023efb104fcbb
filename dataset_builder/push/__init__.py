"""Publishing of a dataset folder as a dataset repository of the Hugging Face Hub."""
