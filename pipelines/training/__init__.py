"""Settings, trainer and run directory of every training. Empty, so that reading settings does not load torch."""
