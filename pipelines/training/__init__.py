"""What every run needs. Empty: the command line reads settings from here, and must not load torch for it."""
