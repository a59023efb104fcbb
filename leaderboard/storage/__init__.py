"""Storage on disk and elsewhere: submission archives, work directories, backups."""
