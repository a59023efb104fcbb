"""Publishing of a dataset folder as a dataset repository of the Hugging Face Hub.

The repository then holds the manifest and the files that it lists, and no others. One commit makes all changes
visible at once, and readers stay at one commit, so that nobody loads the shards of one version with the manifest
of another.
"""
