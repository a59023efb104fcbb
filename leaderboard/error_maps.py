"""Error maps of the worst views, as the command line's report draws them: they show errors, never depth."""
