"""Local and remote storage: submission archives, work directories, backups."""
